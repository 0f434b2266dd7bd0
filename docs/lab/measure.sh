#!/usr/bin/env bash
# Measures what README and docs/lab show of TurboGS, on a machine with a GPU; `make results` calls it:
#
#     docs/lab/measure.sh OUT FOX CALITERRA SNOWMIKU BONSAI TRAIN
#
# The captures are folders of these names. Results lie in OUT/COMMIT; what is there is not measured again, so the same
# call goes on after a stop (Ctrl-C, or `timeout --signal INT 9m`). When all is there, it is copied into docs/lab.
# SEEDS="0 1" has other seeds in the record than five, REPEATS=1 fewer timed commands; STUDIES="" the record alone.
set -euo pipefail
cd "$(dirname "$0")/../.."
if [ -z "${TURBOGS_COMMIT:-}" ] && [ -n "$(git status --porcelain --untracked-files=no)" ]; then
    echo "the sources have changes that are in no commit: commit them first" >&2
    exit 2
fi
out=$1/${TURBOGS_COMMIT:-$(git rev-parse --short HEAD)}
shift
gpus=$(nvidia-smi --list-gpus | wc -l)
mkdir -p "$out"

ablate() { # NAME SEEDS CAPTURE ... [--only VARIANT ...]
    local study=$1 seeds=$2 scenes=()
    shift 2
    while [ $# -gt 0 ] && [ "$1" != --only ]; do scenes+=(--scene "$1") && shift; done
    # shellcheck disable=SC2086 # seeds are words
    turbogs ablate "$study" "${scenes[@]}" "$@" --gpus "$gpus" --out "$out/$study" --seeds $seeds
}

wall() { # VARIANT CAPTURE REPEATS SETTING ...
    local file=$out/wall-$1-$(basename "$2").json gpu=$((walls++ % gpus))
    [ -e "$file" ] || CUDA_VISIBLE_DEVICES=$gpu turbogs bench wall "${@:4}" --scene "$2" --repeats "$3" --out "$file" &
    [ $gpu -lt $((gpus - 1)) ] || wait
}
walls=0

declare -A caps=([fox]=67 [caliterra]=157 [snowmiku]=57 [bonsai]=161 [train]=203) # thousands, FastGS's numbers
for capture in "$@"; do
    cap=cap-${caps[$(basename "$capture")]}k
    ablate record "${SEEDS:-0 1 2 3 4}" "$capture" --only no-exposures ssim "$cap" "ssim-$cap"
done
structure=(density.absgrad_threshold=4.5e-4 pixel_sampler.unit=tile loss.type=sparse_ssim loss.ssim_weight=0.4)
for capture in "$@"; do
    wall turbogs "$capture" "${REPEATS:-3}"
    wall no-exposures "$capture" 1 train.exposure=false
    wall ssim "$capture" 1 "${structure[@]}" train.dropout=auto # configs/turbogs-ssim.yaml
    cap=${caps[$(basename "$capture")]} capped=(train.exposure=false "density.max_gaussians=${cap}000")
    wall "cap-${cap}k" "$capture" 1 "${capped[@]}"
    wall "ssim-cap-${cap}k" "$capture" 1 "${structure[@]}" train.dropout=auto "${capped[@]}"
done
wait
for study in ${STUDIES-paper cameras paper_parts}; do ablate "$study" "0 1 2 3 4" "$@"; done
if [ -n "${STUDIES-all}" ]; then
    ablate baselines "0 1 2" "$@" --only 3dgs
    ablate baselines 0 "${@:1:3}"
    for study in parts components tables; do
        turbogs ablate $study scene.validation=true "${@/#/--scene=}" --gpus "$gpus" --out "$out/$study" --seeds 0
    done
fi

for file in "$out"/*/results.json; do
    study=docs/lab/$(basename "$(dirname "$file")")
    mkdir -p "$study" && cp "$file" "$study/"
done
python - "$out" "$@" <<'PYTHON'
"""Joins the walls: variant -> capture -> what `turbogs bench wall` wrote."""
import json, pathlib, sys

walls = {}
for capture in (pathlib.Path(place).name for place in sys.argv[2:]):
    for file in sorted(pathlib.Path(sys.argv[1]).glob(f"wall-*-{capture}.json")):
        variant = file.stem.removeprefix("wall-").removesuffix(f"-{capture}")
        walls.setdefault(variant, {})[capture] = json.loads(file.read_text())
pathlib.Path("docs/lab/wall.json").write_text(json.dumps(walls) + "\n")
PYTHON
