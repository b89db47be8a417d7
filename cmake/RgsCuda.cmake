# RGS_ENABLE_CUDA: ON where a usable toolkit is found (on PATH or not), OFF with a message where it is not.
# SPDX-License-Identifier: Apache-2.0
# Found before CMake looks itself: CMake tries PATH and CUDACXX only, and toolkits are commonly on neither.
if(NOT CMAKE_CUDA_COMPILER AND NOT DEFINED ENV{CUDACXX})
  file(GLOB rgs_cuda_folders LIST_DIRECTORIES true /usr/local/cuda /usr/local/cuda-* /opt/cuda /opt/cuda-*)
  list(SORT rgs_cuda_folders COMPARE NATURAL ORDER DESCENDING)
  find_program(RGS_NVCC nvcc HINTS $ENV{CUDA_HOME}/bin $ENV{CUDA_PATH}/bin PATHS ${rgs_cuda_folders} PATH_SUFFIXES bin
    DOC "CUDA compiler used when CMAKE_CUDA_COMPILER is not set")
  mark_as_advanced(RGS_NVCC)
elseif(CMAKE_CUDA_COMPILER)
  set(RGS_NVCC "${CMAKE_CUDA_COMPILER}")
else()
  set(RGS_NVCC "$ENV{CUDACXX}")
endif()

# Asked once per build folder: does nvcc, with our C++ compiler as its host compiler, build C++20?
function(rgs_try_nvcc works)
  if(NOT RGS_NVCC)
    set(${works} FALSE PARENT_SCOPE)
    return()
  endif()
  set(key "${RGS_NVCC} ${CMAKE_CXX_COMPILER}")
  if(NOT RGS_NVCC_CHECKED STREQUAL key)
    execute_process(
      COMMAND "${RGS_NVCC}" -std=c++20 -ccbin "${CMAKE_CXX_COMPILER}" -c "${CMAKE_CURRENT_FUNCTION_LIST_DIR}/cuda_check.cu"
        -o "${PROJECT_BINARY_DIR}/cuda_check.o"
      RESULT_VARIABLE status OUTPUT_VARIABLE text ERROR_VARIABLE text)
    string(REGEX REPLACE "[\r\n;]+" " | " text "${text}")
    set(RGS_NVCC_CHECKED "${key}" CACHE INTERNAL "compilers that the check below was made with")
    set(RGS_NVCC_STATUS "${status}" CACHE INTERNAL "exit status of nvcc on cuda_check.cu")
    set(RGS_NVCC_TEXT "${text}" CACHE INTERNAL "what nvcc said")
  endif()
  if(RGS_NVCC_STATUS EQUAL 0)
    set(${works} TRUE PARENT_SCOPE)
  else()
    set(${works} FALSE PARENT_SCOPE)
  endif()
endfunction()

if(NOT DEFINED RGS_ENABLE_CUDA OR RGS_ENABLE_CUDA)
  rgs_try_nvcc(rgs_nvcc_works)
endif()
option(RGS_ENABLE_CUDA "Build the CUDA kernels and the CUDA renderer" ${rgs_nvcc_works})

if(RGS_ENABLE_CUDA AND NOT rgs_nvcc_works)
  if(RGS_NVCC)
    message(FATAL_ERROR "RGS_ENABLE_CUDA is ON, but ${RGS_NVCC} with ${CMAKE_CXX_COMPILER} fails:\n${RGS_NVCC_TEXT}")
  endif()
  message(FATAL_ERROR "RGS_ENABLE_CUDA is ON, but no nvcc is found: set CUDA_HOME or CMAKE_CUDA_COMPILER.")
elseif(RGS_ENABLE_CUDA)
  set(CMAKE_CUDA_COMPILER "${RGS_NVCC}" CACHE FILEPATH "CUDA compiler")
  set(CMAKE_CUDA_HOST_COMPILER "${CMAKE_CXX_COMPILER}" CACHE FILEPATH "host compiler of nvcc")
  if(NOT DEFINED CMAKE_CUDA_ARCHITECTURES)
    # Always explicit: CMake 3.25's own default names architectures that nvcc 13 has dropped. Portable PTX from Turing
    # on plus code for Hopper; presets and -DCMAKE_CUDA_ARCHITECTURES say otherwise.
    set(CMAKE_CUDA_ARCHITECTURES "75-virtual;90-real" CACHE STRING "CUDA architectures to build for")
  endif()
  enable_language(CUDA)
  find_package(CUDAToolkit REQUIRED)
  if(NOT DEFINED CMAKE_CUDA20_STANDARD_COMPILE_OPTION)
    # CMake before 3.26 does not know that nvcc 12 and later take C++20; rgs_try_nvcc has just seen that this one does.
    set(CMAKE_CUDA20_STANDARD_COMPILE_OPTION "-std=c++20")
    set(CMAKE_CUDA20_EXTENSION_COMPILE_OPTION "-std=c++20")
  endif()
  set(CMAKE_CUDA_STANDARD 20)
  set(CMAKE_CUDA_STANDARD_REQUIRED ON)
  message(STATUS "CUDA: on (${RGS_NVCC}, ${CUDAToolkit_VERSION}, architectures ${CMAKE_CUDA_ARCHITECTURES})")
elseif(RGS_NVCC AND DEFINED RGS_NVCC_STATUS AND NOT RGS_NVCC_STATUS EQUAL 0)
  message(STATUS "CUDA: off (${RGS_NVCC} does not build C++20 with ${CMAKE_CXX_COMPILER}: ${RGS_NVCC_TEXT})")
elseif(RGS_NVCC)
  message(STATUS "CUDA: off (RGS_ENABLE_CUDA is OFF)")
else()
  message(STATUS "CUDA: off (no nvcc on PATH, in CUDA_HOME, CUDA_PATH or /usr/local/cuda*)")
endif()
