#!/bin/sh
# status.sh - what became of a Slurm job, in Snakemake's words: status.sh JOB
# SPDX-License-Identifier: Apache-2.0
job=${1%%;*}  # "12;cluster" where there are several clusters
if said=$(scontrol --oneliner show job "$job" 2>&1); then
  state=$(printf '%s\n' "$said" | sed -nE 's/.* JobState=([A-Z_]+).*/\1/p')
else
  case $said in
    *"Invalid job id"*)
      # The controller forgets jobs minutes after their end; accounting, where there is any, does not.
      state=$(sacct --noheader --parsable2 --allocations --format=State --jobs="$job" 2>/dev/null | sed 's/ .*//;q')
      state=${state:-UNKNOWN} ;;
    *) state= ;;  # the controller is away for a moment: ask again
  esac
fi
case $state in
  COMPLETED) echo success ;;
  BOOT_FAIL | CANCELLED | DEADLINE | FAILED | NODE_FAIL | OUT_OF_MEMORY | PREEMPTED | REVOKED | TIMEOUT | UNKNOWN) echo failed ;;
  *) echo running ;;
esac
