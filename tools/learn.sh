#!/usr/bin/env bash
# Runs everything that learns from motion capture and from clips with truth, in the order in which
# one depends on another: priors and motion first, then what the tracker errs by, experts last.
#
#   tools/learn.sh DATA OUT
#
# DATA holds mocap/train, mocap/train_more, mocap/dev with tables index.csv, and video. OUT gets
# files to compare with those that ship; nothing that ships is changed. Tables of YAML files are
# printed to OUT/*.txt, and are put in by hand.
set -euo pipefail
data=${1:?the folder of mocap and video} out=${2:?the folder of the results}
mocap=$data/mocap
[[ -d $mocap/train && -d $data/video ]] || { echo "learn: $data lacks mocap/train or video" >&2; exit 1; }
mkdir -p "$out"
export HMT_SHARED=$data
# Motions whose pelvis is mirrored in parts; their repaired copies are in train_more.
mirrored=(cmu_13_traffic cmu_12_0x_walk cmu_signals_a1 cmu_signals_a2 cmu_run_a)
thanks='The data used in this project was obtained from mocap.cs.cmu.edu. The database was created with funding from NSF EIA-0196217.'
source='CMU Graphics Lab Motion Capture Database, http://mocap.cs.cmu.edu: free for all uses; the data themselves may not be resold, even in converted form.'
prmd='Motions prmd_* are of UI-PRMD, public domain.'
people=("$mocap"/index.csv "$mocap"/train_more/index.csv)

learn() {  # name of the result, then the command
  echo "learn: $1"
  python -m "${@:2}" >"$out/$1.txt"
}
learn lengths hmt_learning learn lengths "$mocap"/train "$mocap"/train_more --people "${people[@]}"
learn prior hmt_learning learn prior "$mocap"/train "$mocap"/train_more --people "${people[@]}" --test "$mocap"/dev \
  --without "${mirrored[@]}" --components 8 --acknowledgement "$source $thanks" -o "$out/human37_prior.npz" --overwrite
learn motion hmt_learning learn motion "$mocap"/train "$mocap"/train_more --without "${mirrored[@]}" \
  --acknowledgement "$thanks" -o "$out/human37_motion.npz" --overwrite
learn keypoint_noise benchmarks keypoint_noise
learn contour_noise benchmarks contour_noise
learn joint_errors benchmarks joint_errors
if python -c 'import jax, optax' 2>/dev/null; then
  # People of the clips that experts are scored on; what ships did not have the last motion either.
  others=('cmu_02_*' 'cmu_07_*' 'cmu_10_*' 'cmu_13_*' "${mirrored[@]}" prmd_s08_m10x_shscaption)
  folders=("$mocap"/train "$mocap"/train_more "$mocap"/train_wide)
  learn experts hmt_learning train --mocap "${folders[@]}" --without "${others[@]}" --alike prmd --test "$mocap"/dev \
    --samples 80000 --acknowledgement "$source $thanks $prmd" -o "$out/silhouettes.npz" --overwrite
  learn lifter hmt_learning learn lifter "${folders[@]}" --without "${others[@]}" --alike prmd --test "$mocap"/dev \
    --acknowledgement "$source $thanks $prmd" -o "$out/keypoints.npz" --overwrite
else
  echo "learn: experts and lifter left out: they need jax and optax" >&2
fi
echo "learn: done; $out has the files and tables to compare with those that ship"
