#!/bin/sh
# The root file system may be read-only, but the compiler insists on a folder that it can write to:
# the caches of the image are copied to /tmp. Then gpom takes the place of this shell, signals and all.
set -eu
mkdir -p "$NUMBA_CACHE_DIR"
cp -R /opt/gpom/cache/. "$NUMBA_CACHE_DIR"
# On another kind of processor than the one the image was built on, loops compile once at the start.
exec gpom "$@"
