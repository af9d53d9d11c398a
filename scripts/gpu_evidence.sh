#!/usr/bin/env bash
# Everything that is to be measured on a GPU, in one go, on a bare machine without network.
#
#   scripts/gpu_evidence.sh --out DIR --minutes N [--wheels DIR] [--python PATH] [--skip STAGE]...
#
# The machine needs Python 3.11 to 3.13 with JAX for its card; what else is missing (mujoco,
# gymnasium, gymnasium-robotics, tyro and what they need) is taken from a folder of wheels. All
# other options are those of scripts/gpu_evidence.py, which tells of the stages: --help.
# To fetch the wheels (40 MB), on a machine with network, for Python 3.12 there:
#   pip download --no-deps --only-binary=:all: --python-version 3.12 --dest wheels \
#     --platform manylinux_2_28_x86_64 --platform manylinux_2_27_x86_64 \
#     --platform manylinux2014_x86_64 mujoco mujoco-core glfw pyopengl etils gymnasium \
#     farama-notifications gymnasium-robotics pettingzoo tyro docstring-parser typeguard
# What it lacks of videos (imageio-ffmpeg) is not needed.
set -euo pipefail
repository="$(cd "$(dirname "$0")/.." && pwd)"
python="$(command -v python3 || command -v python)"
wheels="" rest=()
while (($#)); do
  case "$1" in
    --wheels) wheels="${2:?--wheels needs a folder}"; shift 2 ;;
    --python) python="${2:?--python needs a path}"; shift 2 ;;
    *) rest+=("$1"); shift ;;
  esac
done
export PYTHONPATH="$repository${PYTHONPATH:+:$PYTHONPATH}" PYTHONUNBUFFERED=1
if [[ -n "$wheels" ]]; then
  site="$(mktemp -d)"
  trap 'rm -rf "$site"' EXIT
  "$python" -m pip install --quiet --no-index --no-deps --no-compile --no-cache-dir \
    --disable-pip-version-check --target "$site" "$wheels"/*.whl
  # Behind what is installed: only what is missing comes from the folder.
  export PYTHONPATH="$repository:$site"
fi
"$python" "$repository/scripts/gpu_evidence.py" "${rest[@]}"
