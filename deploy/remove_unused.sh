#!/bin/sh
# Remove files of packages that no program of the service opens: their tests, C headers, Java, symbols for debuggers.
# $1: the environment.
set -eu
packages=$(echo "$1"/lib/python3*/site-packages)
find "$packages" -type d \( -name tests -o -name __pycache__ \) -prune -exec rm -rf {} +
rm -rf "$packages/torch/include" "$packages/torch/test" "$packages/ray/jars" "$packages/ray/cpp" "$packages/ray/rllib"
# of PyTorch's programs, only the manager of its shared memory is used
if [ -d "$packages/torch/bin" ]; then
  find "$packages/torch/bin" -type f ! -name torch_shm_manager -delete
fi
# libraries built with symbols of all functions; those in *.libs were rewritten and must not be stripped
for library in torch/lib/libtorch_cpu.so torch/lib/libtorch_python.so llvmlite/binding/libllvmlite.so ray/_raylet.so \
  ray/core/src/ray/raylet/raylet ray/core/src/ray/gcs/gcs_server backports/zstd/*.so uvloop/*.so; do
  for file in "$packages"/$library; do
    strip --strip-unneeded "$file"
  done
done
