#!/usr/bin/env bash
# Train the paper's networks and make its tables from them.
#
#   experiments/paper/reproduce.sh [full|small|acceleration|tshirt] [OUT]
#
# full: the paper's sizes at 4k vertices, by HOOD's recipe; needs a GPU with the extra `cuda`, and days.
# small: five and sixteen layers at 1k vertices, twice 30,000 steps, two seeds; some forty hours of one CPU core.
# acceleration: five layers at 1k in the paper's own form, 60,000 steps, two seeds; some thirty hours of one CPU core.
# tshirt: the systems that are made for one garment, PBNS to MAT; less than an hour of one CPU core.
# Run it again to go on where it stopped; MINUTES=120 stops it after so long in a training. STEPS=2 shortens every training, to see that all works.
set -euo pipefail
cd "$(dirname "$0")/../.."
size=${1:-full} out=${2:-out/paper${STEPS:+-smoke}}  # what is trained in few steps is not taken for trained

train() { # name, recipe, changes; $start_from are weights, if there are any
  local folder="$out/$1" recipe="experiments/configs/paper/$2.toml"
  shift 2
  [[ -f $folder/model.npz ]] && return
  if compgen -G "$folder/checkpoints/[0-9]*" > /dev/null; then
    eslr train --out "$folder" --resume ${MINUTES:+--minutes "$MINUTES"}
  else
    eslr train --config "$recipe" --out "$folder" ${start_from:+--start-from "$start_from"} \
      "${@/#/--set=}" ${STEPS:+--set=steps=$STEPS} ${MINUTES:+--minutes "$MINUTES"}
  fi
  [[ -f $folder/model.npz ]] || exit 1 # after Ctrl-C or MINUTES it ends without an error
}

one_garment() { # script, system, arguments
  local script="$1" system="$2"
  shift 2
  rows+=("$system=$system@$out/tshirt")
  [[ -f $out/tshirt/${system}_tshirt.npz ]] && return
  [[ $script == posed ]] && set -- tshirt "$system" "$@" || set -- tshirt "$@"
  python experiments/paper "$script" "$@" --out "$out/tshirt" ${STEPS:+--smoke}
}

rows=()
if [[ $size == tshirt ]]; then
  rows=(skinned=skinned)
  one_garment posed pbns --steps 800
  one_garment posed snug --steps 500
  one_garment posed snug-m --steps 500
  one_garment ssch ssch --steps 1200 250
  one_garment mat mat --steps 1400
  rows+=("mat, untrained=mat@$out/tshirt~untrained" optimum=optimum)
  python experiments/paper tables --tables native_garments --garments tshirt --models "${rows[@]}" \
    --out "$out/tables_tshirt" ${STEPS:+--smoke}
  exit
elif [[ $size == full ]]; then
  for model in mgn-15 mgn-48 hood lsdmp-15 gsa-15 eslr-10 eslr-15; do
    train "$model" "$model"
    rows+=("$model=$out/$model/model.npz")
  done
  vertices=4k
elif [[ $size == acceleration ]]; then
  for model in eslr-5 mgn-5 lsdmp-5 gsa-5; do
    for seed in 0 1; do
      train "$model-s$seed" 1k-acceleration "model.base=$model" "seed=$seed"
    done
    rows+=("$model, acceleration=$out/$model-s0/model.npz,$out/$model-s1/model.npz")
  done
  vertices=1k
else
  for model in mgn-5 hood-5 lsdmp-5 gsa-5 eslr-5 mgn-16; do
    for seed in 0 1; do
      train "$model-s$seed" 1k "model.base=$model" "seed=$seed"
      start_from="$out/$model-s$seed/model.npz" train "$model-s$seed-on" 1k "model.base=$model" \
        "seed=$((seed + 10))" horizon_growth=1 learning_rate=5e-4
    done
    rows+=("$model=$out/$model-s0-on/model.npz,$out/$model-s1-on/model.npz")
  done
  vertices=1k
fi
python experiments/paper tables --models guess=guess "${rows[@]}" optimum=optimum --controls \
  --vertices "$vertices" --out "$out/tables" ${STEPS:+--smoke}
