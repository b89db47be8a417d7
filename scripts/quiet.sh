# quiet.sh - sourced by the other scripts: `quiet STEP COMMAND...` logs to a file and speaks up only when it fails.
# SPDX-License-Identifier: Apache-2.0
# shellcheck shell=sh
# In: preset. Out: jobs, log_folder (build/PRESET-logs).
jobs=${RGS_JOBS:-$(nproc)}
log_folder=build/${preset:?}-logs
mkdir -p "$log_folder"

quiet() {
  step=$1
  shift
  began=$(date +%s)
  if "$@" >"$log_folder/$step.log" 2>&1 </dev/null; then
    echo "$preset: $step, $(($(date +%s) - began)) s"
  else
    status=$?
    tail -n "${RGS_TAIL:-60}" "$log_folder/$step.log" >&2
    echo "$preset: $step FAILED with status $status; whole log: $log_folder/$step.log" >&2
    exit "$status"
  fi
}
