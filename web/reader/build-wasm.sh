#!/bin/sh
# build-wasm.sh - builds WebAssembly of a package by Debian's clang-19: sh build-wasm.sh [reader|convert|viewer]; dist/rgs.wasm, and
# build/web/first-view.wasm and splats.wasm of the viewer.
# reader: RGS_FORMAT_PORTABLE of format/CMakeLists.txt, the scheduler of pages in runtime/pages, the framing of .spz, the .cpp files in
# wasm/ and the decoder of Zstandard. Its sources are not in Debian's packages; they come with the npm package zstd-napi.
# convert: all of the format library, the reader of PLY, levels of detail and the conversion of rgs-convert. convert/wasm replaces
# what these take from the host: files by memory, oneTBB by loops.
# viewer: what chooses the first view; what reads PLY and the codes of SPZ. The reader's size is limited.
# SPDX-License-Identifier: Apache-2.0
set -eu
here=$(cd "$(dirname "$0")" && pwd)
root=$(cd "$here/../.." && pwd)
build=$root/build/web
package=${1:-reader}
out=$root/web/$package/dist/rgs.wasm
[ "$package" != viewer ] || out="$build/first-view.wasm $build/splats.wasm"
zstd=$root/web/node_modules/zstd-napi/deps/zstd/lib
llvm=/usr/lib/llvm-19
mkdir -p "$build/include" "$root/web/$package/dist"

for needed in clang-19 clang++-19 wasm-ld-19 wasm-opt ninja; do
  command -v $needed >/dev/null || { echo "build-wasm.sh: no $needed: sh scripts/install-deps.sh page" >&2; exit 1; }
done
[ -d "$zstd" ] || { echo "build-wasm.sh: no $zstd: npm ci in web/" >&2; exit 1; }

# Only these headers, not those of the host's C library beside them.
for header in hwy tl xxhash.h fmt glm nlohmann; do
  ln -sfn "/usr/include/$header" "$build/include/$header"
done
mkdir -p "$build/include/tbb"
for header in blocked_range enumerable_thread_specific parallel_for parallel_pipeline partitioner spin_mutex task_arena task_group; do
  ln -sfn "$root/web/convert/wasm/tbb.hpp" "$build/include/tbb/$header.h"
done
ln -sfn "$root/web/convert/wasm/no_terminal.hpp" "$build/include/console.hpp"

# The same sources as in CMake.
portable=$(sed -nE '/^set\(RGS_FORMAT_PORTABLE/,/^\)/s/^ +(src.*\.cpp)$/\1/p' "$root/format/CMakeLists.txt")
stand_ins=$(sed -nE 's/^set\(RGS_FORMAT_STAND_INS (.*)\)$/\1/p' "$root/format/CMakeLists.txt")
# Every other source, but what the stand-ins replace.
encoder=$(sed -nE 's/^ +(src.*\.cpp)$/\1/p' "$root/format/CMakeLists.txt" | grep -vxE 'src/file/(file|large_pages|workers)\.cpp' |
  grep -vxF "$portable")
levels=$(sed -nE 's/^  ([a-z_]+\.cpp)$/\1/p' "$root/converter/lod/CMakeLists.txt")
# The package's size is limited: what decodes Gaussians is compiled for speed, all else for size, and what opens files and chooses pages
# for the least.
fast=" src/archive/archive_kernels.cpp src/archive/point_decode.cpp src/archive/rans.cpp src/file/row_kernels.cpp \
src/packed/codec_kernels.cpp src/packed/codec_sh.cpp src/packed/frame_decoder.cpp src/packed/inflater.cpp "
small=" src/archive/archive_tables.cpp src/file/layout_io.cpp src/file/load_direct.cpp src/file/open.cpp src/file/result.cpp \
src/file/splat_cloud.cpp src/file/subject_box.cpp src/levels/page.cpp src/levels/page_table.cpp src/levels/paged_file.cpp src/file/validate.cpp \
src/levels/page_decode.cpp src/packed/frames.cpp "
decoder="common/debug common/entropy_common common/error_private common/fse_decompress common/xxhash common/zstd_common
  decompress/huf_decompress decompress/zstd_ddict decompress/zstd_decompress_block decompress/zstd_decompress"
compressor="compress/fse_compress compress/hist compress/huf_compress compress/zstd_compress compress/zstd_compress_literals
  compress/zstd_compress_sequences compress/zstd_compress_superblock compress/zstd_double_fast compress/zstd_fast compress/zstd_lazy
  compress/zstd_ldm compress/zstd_opt compress/zstd_preSplit"

# Without errno a square root is one instruction. Debian's headers of libc++ and of the C library are for wasm32-wasi.
{
  echo "launcher = $(command -v ccache || :)"
  echo "size = -Os"
  echo "flags = --target=wasm32-wasi -msimd128 -mbulk-memory -mnontrapping-fptoint -msign-ext -fno-math-errno $
    -ffp-contract=off -fno-exceptions -ffunction-sections -fdata-sections -DNDEBUG -Wall -Wextra -Werror"
  echo "cxx_flags = -std=c++20 -fno-rtti -fno-threadsafe-statics -nostdinc++ -isystem $llvm/include/wasm32-wasi/c++/v1 $
    -isystem /usr/include/wasm32-wasi -isystem $build/include -DXXH_INLINE_ALL -I$root/format/include -I$root/format/src $
    -I$root/kernels/math/include -I$root/runtime -I$root/converter/formats -I$root/converter/formats/include $
    -isystem $zstd"
  echo "converter_flags = -I$root/converter/convert -I$root/converter/lod -I$root/runtime/include $
    -I$root/runtime/src -DFMT_HEADER_ONLY"
  echo "c_flags = -std=c11 -isystem /usr/include/wasm32-wasi -I$zstd -DZSTD_DISABLE_ASM -DZSTD_LEGACY_SUPPORT=0 $
    -DZSTD_STRIP_ERROR_STRINGS -DXXH_NAMESPACE=ZSTD_ -DDEBUGLEVEL=0 -Wno-unused-parameter -Wno-unused-function"
  echo "rule cxx
  command = \$launcher clang++-19 \$flags \$cxx_flags \$more \$size -MMD -MF \$out.d -c \$in -o \$out
  depfile = \$out.d
  deps = gcc
rule c
  command = \$launcher clang-19 \$flags \$c_flags \$size -MMD -MF \$out.d -c \$in -o \$out
  depfile = \$out.d
  deps = gcc
rule link
  command = wasm-ld-19 --no-entry --gc-sections --strip-all -O2 --global-base=1024 --export=_initialize -z stack-size=262144 $
    --max-memory=4294967296 -L/usr/lib/wasm32-wasi -L$llvm/lib/wasm32-wasi /usr/lib/wasm32-wasi/crt1-reactor.o \$in $
    -lc++ -lc++abi -lc $llvm/lib/clang/19/lib/wasi/libclang_rt.builtins-wasm32.a $
    -o \$out.linked && wasm-opt -O3 -ocimfs 100 --low-memory-unused --enable-simd --enable-bulk-memory --enable-nontrapping-float-to-int $
    --enable-sign-ext \$out.linked -o \$out && rm \$out.linked"
  shared=
  for source in $portable $stand_ins; do
    echo "build $build/$source.o: cxx $root/format/$source"
    case $fast in *" $source "*) echo "  size = -O2" ;; esac
    case $small in *" $source "*) echo "  size = -Oz" ;; esac
    shared="$shared $build/$source.o"
  done
  inflater=
  for source in $decoder; do
    echo "build $build/zstd/$source.o: c $zstd/$source.c"
    inflater="$inflater $build/zstd/$source.o"
  done
  echo "build $build/no_console.o: cxx $here/wasm/no_console.cpp"
  echo "  size = -Oz"
  objects=
  for source in "$root"/runtime/pages/*.cpp "$root/converter/formats/spz_header.cpp"; do
    echo "build $build/others/$(basename "$source").o: cxx $source"
    echo "  size = -Oz"
    objects="$objects $build/others/$(basename "$source").o"
  done
  for source in reader pages; do
    echo "build $build/$source.o: cxx $here/wasm/$source.cpp"
    echo "  size = -Oz"
    objects="$objects $build/$source.o"
  done
  echo "build $root/web/reader/dist/rgs.wasm: link $shared $objects $build/no_console.o $inflater"
  for source in format/src/file/first_view.cpp web/viewer/wasm/first_view.cpp; do
    echo "build $build/viewer/$source.o: cxx $root/$source"
    echo "  size = -Oz"
  done
  echo "build $build/first-view.wasm: link $build/viewer/format/src/file/first_view.cpp.o $build/viewer/web/viewer/wasm/first_view.cpp.o $
    $build/src/file/subject_box.cpp.o $build/no_console.o"
  objects="$shared $build/no_console.o"
  for source in converter/formats/ply_header.cpp converter/formats/ply_reader.cpp converter/formats/spool_file.cpp \
    converter/formats/stated_scene.cpp converter/formats/splat_edit.cpp converter/formats/sh_rotation.cpp converter/formats/spz_codes.cpp \
    converter/formats/spz_header.cpp web/convert/wasm/memory_files.cpp web/viewer/wasm/splats.cpp; do
    echo "build $build/viewer/$source.o: cxx $root/$source"
    objects="$objects $build/viewer/$source.o"
  done
  echo "build $build/splats.wasm: link $objects"
  objects="$build/no_console.o $inflater"
  for source in $compressor; do
    echo "build $build/zstd/$source.o: c $zstd/$source.c"
    echo "  size = -O2"
    objects="$objects $build/zstd/$source.o"
  done
  for source in $(printf "format/%s " $encoder) $(printf "converter/lod/%s " $levels) converter/lod/fit_device_absent.cpp \
    converter/formats/ply_header.cpp converter/formats/ply_reader.cpp converter/formats/spool_file.cpp converter/formats/stated_scene.cpp \
    converter/formats/splat_edit.cpp converter/formats/sh_rotation.cpp converter/convert/convert_to_rgs.cpp \
    converter/convert/depth_range.cpp converter/convert/input_declarations.cpp runtime/src/cameras/camera.cpp \
    web/convert/wasm/converter.cpp web/convert/wasm/memory_files.cpp; do
    echo "build $build/converter/$source.o: cxx $root/$source"
    echo "  size = -O2"
    echo "  more = \$converter_flags"
    objects="$objects $build/converter/$source.o"
  done
  echo "build $root/web/convert/dist/rgs.wasm: link $shared $objects"
} >"$build/build.ninja"
# shellcheck disable=SC2086 # a list
ninja -C "$build" --quiet $out
