# Finds what the build needs; a missing package stops the build and names the Debian package that has it.
# SPDX-License-Identifier: Apache-2.0
set(THREADS_PREFER_PTHREAD_FLAG ON)
# What one folder finds the others may link: a folder asks for what it uses itself, not for what its tests use.
set(CMAKE_FIND_PACKAGE_TARGETS_GLOBAL ON)
find_package(Threads REQUIRED)

macro(rgs_require name debian)
  find_package(${name} QUIET ${ARGN})
  if(NOT ${name}_FOUND)
    message(FATAL_ERROR "RoofGS needs ${name}: install ${debian} (Debian 12), or set CMAKE_PREFIX_PATH to where it is.")
  endif()
endmacro()

rgs_require(tl-expected libexpected-dev CONFIG)
rgs_require(xxHash libxxhash-dev)
