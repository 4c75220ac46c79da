# Put the executables of relay_autotune on the PATH and its messages on Python's path, with the
# ROS 2 that `make setup` used. Source it, in bash, zsh or sh (in sh from the repository's folder):
#
#     . ./env.sh

# bash and zsh know the file that they read, sh does not
if [ -n "$BASH_VERSION" ]; then
    relay_autotune_root=$(dirname "$BASH_SOURCE")
elif [ -n "$ZSH_VERSION" ]; then
    eval 'relay_autotune_root=${${(%):-%x}:h}'
else
    relay_autotune_root=.
fi
relay_autotune_root=$(cd "$relay_autotune_root" && pwd -P)

if [ ! -f "$relay_autotune_root/install/relay_autotune/.prepared" ]; then
    echo "env.sh: $relay_autotune_root is not set up: run \`make setup\` there" >&2
    unset relay_autotune_root
    return 1
fi

# the wheels' ROS is the virtual environment; a ROS that was sourced is known to install/setup.sh
if [ -d "$relay_autotune_root/.venv/share/rclpy" ]; then
    case ":$AMENT_PREFIX_PATH:" in
    *":$relay_autotune_root/.venv:"*) ;;
    *)
        if [ -n "$ROS_DISTRO" ] && [ -n "$AMENT_PREFIX_PATH" ]; then
            echo "env.sh: a ROS is sourced, and another one was set up: run \`make setup\`" >&2
            unset relay_autotune_root
            return 1
        fi
        export AMENT_PREFIX_PATH="$relay_autotune_root/.venv${AMENT_PREFIX_PATH:+:$AMENT_PREFIX_PATH}"
        export CMAKE_PREFIX_PATH="$relay_autotune_root/.venv${CMAKE_PREFIX_PATH:+:$CMAKE_PREFIX_PATH}"
        ;;
    esac
fi
COLCON_CURRENT_PREFIX="$relay_autotune_root/install"
. "$relay_autotune_root/install/setup.sh"
# an empty entry, as colcon may leave one at the end, would mean the current folder
export LD_LIBRARY_PATH="${LD_LIBRARY_PATH%:}"

case ":$PATH:" in
*":$relay_autotune_root/.venv/bin:"*) ;;
*) export PATH="$relay_autotune_root/install/relay_autotune/lib/relay_autotune:$relay_autotune_root/.venv/bin:$PATH" ;;
esac
export VIRTUAL_ENV="$relay_autotune_root/.venv"
unset relay_autotune_root
