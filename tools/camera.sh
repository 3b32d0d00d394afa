#!/usr/bin/env bash
# Shows the people before a webcam, or in a video file: what camera.launch.py does, in the environment
# of "make setup", which has no launch files.
#
#     tools/camera.sh VIDEO [FOV [PEOPLE]]
#
# FOV is the field of view from left to right, degrees; empty: it is guessed. PEOPLE above 1 tracks
# so many. RViz starts where a ROS 2 from apt has it.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
video=${1:?usage: tools/camera.sh VIDEO [FOV [PEOPLE]]} fov=${2:-} people=${3:-1}
ros=${ROS_FROM_APT:-/opt/ros/jazzy}
say() { printf 'camera: %s\n' "$*" >&2; }
[[ -e $video || $video =~ ^[0-9]+$ ]] || { say "$video is not there: wanted a webcam such as /dev/video0, or a video file"; exit 1; }
[[ $people =~ ^([1-9]|1[0-9]|20)$ ]] || { say "PEOPLE: wanted a number from 1 to 20, saw $people"; exit 1; }
# The files of a workspace read variables that are not set.
set +u
source tools/environment.bash
set -u
export FASTRTPS_DEFAULT_PROFILES_FILE=${FASTRTPS_DEFAULT_PROFILES_FILE:-$PWD/hmt_ros/config/fastdds.xml}
tracker=filter_node lens=()
[ "$people" = 1 ] || tracker=people_node
[ -n "$fov" ] || lens=(-p "$tracker:focal_length_sigma:=$(python -c \
  'from hmt_ros.sessions.focal_length import USUAL_SIGMA as sigma; print(sigma)')")

running=()
stop() {
  trap - EXIT INT TERM
  [ ${#running[@]} -eq 0 ] && return
  kill -TERM "${running[@]}" 2>/dev/null || true
  # What has not ended after 10 s never will.
  { sleep 10 && kill -KILL "${running[@]}"; } 2>/dev/null &
  wait "${running[@]}" || true
  kill $! 2>/dev/null || true
}
trap stop EXIT INT TERM
# The first that ends, camera, node or RViz, ends all.
start() {
  "$@" &
  running+=($!)
}
node() {
  local name=$1
  shift
  start python -m "hmt_ros.nodes.$name" "$@" -r image:=/camera/image_raw -r camera_info:=/camera/camera_info
}

if [ "$people" = 1 ]; then
  space=/humans/bodies/p1 layout=hmt.rviz nodes='filter_node smoother_node keypoints_node'
  # shellcheck disable=SC2086
  node person_node $nodes --ros-args -r __ns:=$space "${lens[@]}"
else
  space='' layout=people.rviz nodes='keypoints_node people_node'
  node keypoints_node --ros-args -p people:="$people"
  node people_node --ros-args -p source:=people -p max_people:="$people" "${lens[@]}"
fi

if [ -x "$ros/lib/rviz2/rviz2" ]; then
  # With nothing of this environment.
  foreign=(env -u PYTHONPATH -u LD_LIBRARY_PATH -u AMENT_PREFIX_PATH bash -c 'source "$0" && exec ros2 run "$@"' "$ros/setup.bash")
  start "${foreign[@]}" tf2_ros static_transform_publisher --qx 0.5 --qy -0.5 --qz 0.5 --qw 0.5 \
    --frame-id camera_optical_frame --child-frame-id camera_upright
  start "${foreign[@]}" rviz2 rviz2 -d "$PWD/rviz/$layout" --ros-args -r __ns:="${space:-/}"
else
  say "RViz is not in $ros (sudo apt install ros-jazzy-rviz2); topics are in ${space:-/}"
fi

wait_for=''
for name in $nodes; do wait_for="$wait_for $space/$name"; done
start python -m hmt_ros.nodes.camera_node "$video" ${fov:+--fov "$fov"} --ros-args -r __ns:=/camera -p wait_for:="${wait_for# }"
wait -n
