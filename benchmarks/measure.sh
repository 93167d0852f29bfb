#!/usr/bin/env bash
# Measures what depends on time, on a quiet machine, and writes the records and docs/results.md: 25 minutes.
# PYTHON has the contrib modules of OpenCV 4, for CSRT and KCF; TRACKING_DATA is the folder of sequences.
set -eu
cd "$(dirname "$0")/.."
python=${PYTHON:-.venv/bin/python}
unset OPENBLAS_NUM_THREADS OMP_NUM_THREADS PYTHONDONTWRITEBYTECODE  # as in a process of a user
catstream=$(dirname "$python")/catstream

measure() { # NAME SCRIPT [OPTION...]: benchmarks/results/NAME.json
    local name=$1 began=$SECONDS
    shift
    "$@" --json "benchmarks/results/$name.json"
    echo "== $name: $((SECONDS - began)) s"
}

measure startup "$python" benchmarks/startup.py --runs 3
measure resume "$python" benchmarks/resume.py --moments 8
"$python" benchmarks/provenance.py benchmarks/results/loadtest.json "$catstream" loadtest --find streams --streams 3 \
    --source h264
measure speed "$python" benchmarks/speed.py --frames 600 \
    --sequences TLD_01_david TLD_06_car OTB_Woman TLD_10_panda
"$python" benchmarks/page.py
