#!/bin/sh
# MuJoCo draws without a display through EGL, and OpenCV (which robosuite imports) needs two libraries of its own.
# Checks that they can be loaded. As root it installs Debian's packages; otherwise it prints the missing libraries.
set -eu

missing() {
  .venv/bin/python - <<'PYTHON'
import ctypes
for library in ("libEGL.so.1", "libOpenGL.so.0", "libGL.so.1", "libgthread-2.0.so.0"):
    try:
        ctypes.CDLL(library)
    except OSError:
        print(library)
PYTHON
}

packages="libegl1 libegl-mesa0 libopengl0 libgl1 libgl1-mesa-dri libglib2.0-0"
libraries=$(missing | tr '\n' ' ')
[ -z "$libraries" ] && exit 0

if [ "$(id -u)" = 0 ] && command -v apt-get >/dev/null; then
  echo "Installing system libraries for headless rendering: $packages"
  # shellcheck disable=SC2086
  apt-get update -qq &&
    DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends $packages >/dev/null
  libraries=$(missing | tr '\n' ' ')
  [ -z "$libraries" ] && exit 0
fi
echo "Rendering needs system libraries that are missing ($libraries); install them, on Debian or Ubuntu with:" >&2
echo "  sudo apt-get install -y $packages" >&2
exit 1
