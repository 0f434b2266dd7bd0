#!/bin/sh
# Measures docs/scaling.md on a machine with two GPUs: sh docs/measure_scaling.sh OUT FOX CALITERRA [DEVICE]
# The tests of the exchange, iterations on one GPU and on two, whole runs, which end if their replicas differ, and a
# study.
set -e
out=$1 fox=$2 caliterra=$3 device=${4:-cuda}
python=${PYTHON:-python3}
turbogs() { "$python" -m turbogs_plugin "$@"; }
test "$device" = cpu || "$python" -m pytest -q -p no:cacheprovider tests/gpu/test_ranks.py
turbogs bench ranks --scene "$fox" --gpus 1 2 --views 3 10 --grown --device "$device" ${BENCH:-} --out "$out/ranks.json"
for seed in ${SEEDS:-0 1 2}; do
    for gpus in 1 2; do
        turbogs train "$caliterra" --out "$out/runs/$gpus-$seed" --gpus $gpus --no-report --device "$device" \
            train.seed=$seed ${TRAIN:-} 2>/dev/null | tail -2
    done
    # Twice the pixels and views for the same time, with rates times the root of two.
    turbogs train "$caliterra" --out "$out/runs/2-more-$seed" --gpus 2 --no-report --device "$device" train.seed=$seed \
        schedule.pixel_budget=2 schedule.min_views=6 schedule.max_views=20 optimizer.learning_rates.batch_scale=7.07 \
        ${TRAIN:-} 2>/dev/null | tail -2
done
"$python" docs/time_to_psnr.py "$out"/runs/*
for gpus in 0 0,1; do
    started=$(date +%s)
    turbogs ablate parts --scene "$caliterra" --only random-pixels --seeds 0 1 2 --gpus $gpus --device "$device" \
        --out "$out/study-$gpus" ${STUDY:-} >/dev/null
    echo "study on GPUs $gpus: $(($(date +%s) - started)) s"
done
