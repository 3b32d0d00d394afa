#!/usr/bin/env bash
# Builds what is published, a wheel and an archive of the sources, into build/release. It refuses where something
# is not ready to be public: changes that are not committed, or addresses that stand for real ones.
#
#     tools/release.sh
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
fail() { printf 'release: %s\n' "$1" >&2; exit 1; }
[ -z "$(git status --porcelain)" ] || fail 'wanted a tree without changes, saw some: commit them first'
files=(package.xml setup.py examples/package.xml msg_tools/hmt_msgs/package.xml)
named=$(grep -l 'example\.com' "${files[@]}" | paste -sd ' ' || true)
[ -z "$named" ] || fail "example.com stands for addresses in $named: put in the public ones first"
rm -rf build/release && mkdir -p build/release
version=$(sed -n 's:.*<version>\(.*\)</version>.*:\1:p' package.xml)
git archive --prefix="hmt_ros-$version/" -o "build/release/hmt_ros-$version.tar.gz" HEAD
.venv/bin/python -m pip -q wheel --no-deps -w build/release .
ls build/release
