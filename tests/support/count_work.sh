#!/bin/sh
# count_work.sh - runs a test whose growth() counts instructions: sh count_work.sh PROGRAM ARGUMENTS...
# On one processor, because waiting threads also execute instructions.
# SPDX-License-Identifier: Apache-2.0
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
processor=$(taskset -cp $$ | sed 's/.*: //; s/[-,].*//')
taskset -c "$processor" valgrind -q --tool=callgrind --instr-atstart=no "$@"
