#!/bin/sh
# Takes out of a virtual environment what a running service never opens.
set -eu
cd "$1"
find . -type d \( -name tests -o -name test -o -name testing \) \
  \( -path '*/numba/*' -o -path '*/scipy/*' -o -path '*/PIL/*' -o -path '*/pygments/*' \) \
  -not -path '*/numba/testing*' -not -path '*/numba/tests/__init__.py' -prune -exec rm -r {} +
find . -type d -path '*/numpy/*/tests' -prune -exec rm -r {} +
find . -type f \( -name '*.pyi' -o -name '*.c' -o -name '*.h' -o -name '*.map' -o -name '*.a' \) -delete
rm -rf lib/python3*/site-packages/numpy/_core/include
