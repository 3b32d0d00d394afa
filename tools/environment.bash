# The environment in which the built packages run; to be sourced, after "make setup":
#
#     source tools/environment.bash
#
# It does for .venv what /opt/ros/jazzy/setup.bash does for a ROS installation, and then sources
# install/. It removes the settings of another ROS installation from this shell.

_root=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)
unset PYTHONPATH PYTHONHOME LD_LIBRARY_PATH COLCON_PREFIX_PATH _ROS_WHEELS_BOOTSTRAP_COMPLETE
export VIRTUAL_ENV=$_root/.venv
export AMENT_PREFIX_PATH=$VIRTUAL_ENV CMAKE_PREFIX_PATH=$VIRTUAL_ENV
export PATH=$VIRTUAL_ENV/bin:$PATH
export ROS_DISTRO=jazzy ROS_VERSION=2 ROS_PYTHON_VERSION=3
source "$_root/install/local_setup.bash"
# Where the wheels keep their libraries, and those of others that these need: a program in C++ does
# not find them by itself.
for _folder in "$VIRTUAL_ENV"/lib "$VIRTUAL_ENV"/lib/python3.*/site-packages/ros_*.libs; do
  export LD_LIBRARY_PATH=${LD_LIBRARY_PATH:+${LD_LIBRARY_PATH%:}:}$_folder
done
# Nodes and commands run the sources, not the copy in install/.
export PYTHONPATH=$_root:$PYTHONPATH
# DDS communicates on this machine only, unless the variable is set already.
export ROS_AUTOMATIC_DISCOVERY_RANGE=${ROS_AUTOMATIC_DISCOVERY_RANGE:-LOCALHOST}
unset _root _folder
