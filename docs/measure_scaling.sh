#!/bin/sh
# Measures docs/scaling.md on a machine with two GPUs or four: sh docs/measure_scaling.sh OUT FOX CALITERRA [DEVICE]
#
# What says the most comes first. No stage stops another one: each has its time, its own OUT/NAME.txt and NAME.err, and
# after each group OUT/results.txt is written anew with all that is known. WITHIN seconds (470) in all; a stage that
# would not end before is left out. One that runs into it is asked to end, and killed after 5 s; no signal of `timeout`
# comes to the processes that it started, in sessions of their own, but they end with it. Models and checkpoints go to
# SCRATCH, as they are large; OUT keeps a few kilobytes. RANKS=no, STUDY=no: without the iterations, without the study.
out=$1 fox=$2 caliterra=$3 device=${4:-cuda}
test -n "$caliterra" || { echo "sh docs/measure_scaling.sh OUT FOX CALITERRA [DEVICE]"; exit 2; }
python=${PYTHON:-python3} within=${WITHIN:-470} scratch=${SCRATCH:-$(mktemp -d)} begun=$(date +%s)
export NCCL_NVLS_ENABLE=0 OMP_NUM_THREADS="${OMP_NUM_THREADS:-8}"
mkdir -p "$out/runs" "$scratch" || exit 2

counts="1 2" all=0,1 four=$([ "$("$python" -c "import torch; print(torch.cuda.device_count())")" -ge 4 ] && echo yes)
test -n "$four" && counts="1 2 4" all=0,1,2,3

elapsed() { echo $(($(date +%s) - begun)); }

say() { echo "[$(elapsed) s] $*" | tee -a "$out/stages.txt"; }

results() { "$python" docs/scaling_results.py "$out" >"$out/results.new" && mv "$out/results.new" "$out/results.txt"; }

# stage NAME SECONDS COMMAND ...: SECONDS is the least that it needs, on an H200.
stage() {
    name=$1 least=$2 started=$(elapsed)
    shift 2
    if [ $((within - started)) -lt "$least" ]; then
        say "$name: left out, it may take $least s"
        return 1
    fi
    timeout -k 5 $((within - started)) "$@" >"$out/$name.txt" 2>"$out/$name.err"
    code=$?
    say "$name: $(($(elapsed) - started)) s, exit code $code"
    [ $code -eq 0 ] || tail -n 5 "$out/$name.err"
    return $code
}

# run KIND SEED GPUS SETTING ...: a whole training of caliterra, which ends if its replicas differ.
run() {
    kind=$1 seed=$2 gpus=$3
    shift 3
    stage "run-$kind-$seed" 25 "$python" -m turbogs_plugin train "$caliterra" --out "$scratch/$kind-$seed" \
        --gpus "$gpus" --no-report --device "$device" "train.seed=$seed" "$@" ${TRAIN:-}
    mkdir -p "$out/runs/$kind-$seed"
    for file in history.jsonl plan.json config.yaml wall.json; do
        cp "$scratch/$kind-$seed/$file" "$out/runs/$kind-$seed/" 2>/dev/null
    done
    rm -rf "${scratch:?}/$kind-$seed"
}

# The numbers that the rest waits for: iterations on one GPU and on two. 1000 Gaussians say what the host takes.
stage machine 0 sh -c "nvidia-smi topo -m; nvidia-smi --query-gpu=name,driver_version --format=csv; git rev-parse HEAD"
test "${RANKS:-}" = no ||
    stage ranks 60 "$python" -m turbogs_plugin bench ranks --scene "$fox" --gpus $counts \
        --gaussians 600000 150000 1000 --views 10 3 --grown --device "$device" --out "$out/ranks.json" ${BENCH:-}
runs() {
    run one "$1" 1
    run two "$1" 2 train.batch_for=1  # the batch of one GPU
    test -z "$four" || run four "$1" 4 train.batch_for=1
    run batch "$1" 2 train.batch_for=auto  # twice the views and pixels
    results
}
results
runs 0
for gpus in $(test "${STUDY:-}" = no || echo 0 $all); do
    stage "study-$gpus" 60 "$python" -m turbogs_plugin ablate parts --scene "$caliterra" --only turbogs \
        --seeds ${CELLS:-0 1 2 3 4 5} --gpus $gpus --device "$device" --out "$out/study-$gpus" ${STUDY:-}
done
results
runs 1
runs 2
test "$device" = cpu ||
    stage tests 30 "$python" -m pytest -q -p no:cacheprovider tests/gpu/test_ranks.py tests/gpu/test_masks.py
rm -rf "$scratch"
cat "$out/results.txt"
