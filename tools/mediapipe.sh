#!/usr/bin/env bash
# Makes .mediapipe, an environment of its own for the detector: MediaPipe needs numpy below 2, and does
# not run with every Python that .venv may have.
#
#     tools/mediapipe.sh
#
# PYTHON=/path/to/python selects the interpreter; the default is the first suitable one.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

fail() {
  printf 'hmt_ros: %s\n' "$*" >&2
  exit 1
}

key=$(sha256sum requirements/mediapipe.txt)
[ "$(cat .mediapipe/stamp 2>/dev/null)" != "$key" ] || exit 0

unset PYTHONPATH PYTHONHOME
fits='import ensurepip, sys, venv; sys.exit(not ((3, 9) <= sys.version_info[:2] <= (3, 12)))'
chosen=''
for candidate in ${PYTHON:-.venv/bin/python python3 python3.12 python3.11 python3.10 python3.9}; do
  if "$candidate" -c "$fits" 2>/dev/null; then
    chosen=$candidate
    break
  fi
done
[ -n "$chosen" ] || fail 'MediaPipe 0.10.21 needs CPython 3.9 to 3.12 with its venv module. Name one:' \
  'make mediapipe PYTHON=/path/to/python3.12'

rm -rf .mediapipe
printf 'hmt_ros: creating .mediapipe with %s, once\n' "$("$chosen" --version)" >&2
"$chosen" -m venv .mediapipe
.mediapipe/bin/python -m pip -qq --disable-pip-version-check --no-input install -r requirements/mediapipe.txt
reason=$(.mediapipe/bin/python -c 'import mediapipe' 2>&1) ||
  fail "MediaPipe can not be imported: ${reason##*$'\n'}. Try: sudo apt install libgl1 libegl1"
echo "$key" >.mediapipe/stamp
