# Builds programs for 64-bit Windows by Debian's MinGW-w64; packaging/windows.sh builds the libraries in RGS_WINDOWS_PREFIX.
# SPDX-License-Identifier: Apache-2.0
set(CMAKE_SYSTEM_NAME Windows)
set(CMAKE_SYSTEM_PROCESSOR x86_64)
# POSIX threads: std::thread and std::mutex.
set(CMAKE_C_COMPILER x86_64-w64-mingw32-gcc-posix)
set(CMAKE_CXX_COMPILER x86_64-w64-mingw32-g++-posix)
set(CMAKE_RC_COMPILER x86_64-w64-mingw32-windres)
# Windows aligns stacks to 16 bytes, and gcc keeps vectors of 32 there all the same (its bug 54412): moves that need no alignment.
# -Wno-attributes: visibility means nothing there.
set(CMAKE_C_FLAGS_INIT "-Wa,-muse-unaligned-vector-move -D_WIN32_WINNT=0x0A00 -DZIP_STATIC")
set(CMAKE_CXX_FLAGS_INIT "${CMAKE_C_FLAGS_INIT} -Wno-attributes")
set(ZLIB_USE_STATIC_LIBS ON)
# Each program is one file. libzip needs zlib after it.
set(CMAKE_EXE_LINKER_FLAGS_INIT "-static")
set(CMAKE_CXX_STANDARD_LIBRARIES "-lz")
set(CMAKE_TRY_COMPILE_PLATFORM_VARIABLES RGS_WINDOWS_PREFIX)
set(CMAKE_FIND_ROOT_PATH ${RGS_WINDOWS_PREFIX} /usr/x86_64-w64-mingw32)
set(CMAKE_FIND_ROOT_PATH_MODE_PROGRAM NEVER)
set(CMAKE_FIND_ROOT_PATH_MODE_LIBRARY ONLY)
set(CMAKE_FIND_ROOT_PATH_MODE_INCLUDE ONLY)
set(CMAKE_FIND_ROOT_PATH_MODE_PACKAGE ONLY)
set(CMAKE_FIND_PACKAGE_PREFER_CONFIG ON)
