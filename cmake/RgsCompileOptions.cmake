# rgs_compile_options: warnings, sanitizers and floating-point rules of our own targets; never exported.
# SPDX-License-Identifier: Apache-2.0
add_library(rgs_compile_options INTERFACE)
target_compile_features(rgs_compile_options INTERFACE cxx_std_20)
# -ffp-contract=off: a*b+c rounds twice everywhere, so that gcc, clang, Debug and Release give the same bits.
target_compile_options(rgs_compile_options INTERFACE
  $<$<COMPILE_LANGUAGE:CXX>:-Wall -Wextra -Wpedantic -Wshadow -Wconversion -Wsign-conversion -ffp-contract=off>
  $<$<COMPILE_LANG_AND_ID:CXX,Clang>:-Wreserved-identifier>
  $<$<AND:$<COMPILE_LANGUAGE:CXX>,$<BOOL:${RGS_WERROR}>>:-Werror>
  # gcc 12 reports overlapping copies inside std::string's own insert and assign at -O3 (its bugs 105329 and 105651).
  $<$<AND:$<COMPILE_LANG_AND_ID:CXX,GNU>,$<VERSION_LESS:$<CXX_COMPILER_VERSION>,13>>:-Wno-restrict>
  # nvcc passes these on; -Wpedantic and the conversion warnings would fire in the host code that it generates.
  $<$<COMPILE_LANGUAGE:CUDA>:-Xcompiler=-Wall,-Wextra,-ffp-contract=off>
  $<$<AND:$<COMPILE_LANGUAGE:CUDA>,$<BOOL:${RGS_WERROR}>>:--Werror=all-warnings>
  # Device code takes a third to a fifth of the space that the default mode gives it.
  $<$<AND:$<COMPILE_LANGUAGE:CUDA>,$<VERSION_GREATER_EQUAL:$<CUDA_COMPILER_VERSION>,12.8>>:--compress-mode=size>)
if(RGS_SANITIZE)
  # The checks' extra branches mislead gcc's flow analysis into warnings that the plain builds do not have.
  target_compile_options(rgs_compile_options INTERFACE
    $<$<COMPILE_LANGUAGE:CXX>:-fsanitize=${RGS_SANITIZE} -fno-sanitize-recover=all -fno-omit-frame-pointer>
    $<$<COMPILE_LANG_AND_ID:CXX,GNU>:-Wno-maybe-uninitialized -Wno-stringop-overflow>
    # libFuzzer's coverage counters; its main() is linked to the fuzz targets alone.
    $<$<AND:$<COMPILE_LANGUAGE:CXX>,$<BOOL:${RGS_BUILD_FUZZERS}>>:-fsanitize=fuzzer-no-link>)
  target_link_options(rgs_compile_options INTERFACE -fsanitize=${RGS_SANITIZE})
endif()

# Compiler caching, where ccache is installed and the caller has no launcher of their own.
if(PROJECT_IS_TOP_LEVEL)
  find_program(RGS_CCACHE ccache)
  foreach(language CXX CUDA)
    if(RGS_CCACHE AND NOT DEFINED CMAKE_${language}_COMPILER_LAUNCHER)
      # With paths relative to the checkout, so that one in another folder finds the same objects.
      set(CMAKE_${language}_COMPILER_LAUNCHER
        ${CMAKE_COMMAND} -E env CCACHE_BASEDIR=${PROJECT_SOURCE_DIR} CCACHE_NOHASHDIR=1 ${RGS_CCACHE})
    endif()
  endforeach()
  set(CMAKE_RUNTIME_OUTPUT_DIRECTORY ${PROJECT_BINARY_DIR}/bin)
  set(CMAKE_LIBRARY_OUTPUT_DIRECTORY ${PROJECT_BINARY_DIR}/lib)
  # Programs look for libraries beside themselves first, so that a folder of both runs anywhere (scripts/bundle.sh).
  set(CMAKE_INSTALL_RPATH "$ORIGIN/../lib" "$ORIGIN/../${CMAKE_INSTALL_LIBDIR}")
  list(REMOVE_DUPLICATES CMAKE_INSTALL_RPATH)
  set(CMAKE_INSTALL_RPATH_USE_LINK_PATH ON)
  set(CMAKE_BUILD_WITH_INSTALL_RPATH ON)
  if(NOT WIN32)
    # As DT_RPATH, which libraries of libraries are looked for by as well; DT_RUNPATH is for the program's own alone.
    add_link_options(-Wl,--disable-new-dtags)
    # A program loads what it calls. libcurl alone brings thirty libraries along, which take 20 ms to load.
    add_link_options(-Wl,--as-needed)
  endif()
endif()
