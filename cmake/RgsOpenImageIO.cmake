# RGS_ENABLE_OPENIMAGEIO: ON where OpenImageIO is found, OFF with a message where it is not.
# SPDX-License-Identifier: Apache-2.0
if(NOT DEFINED RGS_ENABLE_OPENIMAGEIO OR RGS_ENABLE_OPENIMAGEIO)
  find_package(OpenImageIO QUIET MODULE)
  set(rgs_looked_for_openimageio TRUE)
endif()
option(RGS_ENABLE_OPENIMAGEIO "Read and write OpenEXR, TIFF and other pictures, through OpenImageIO" "${OpenImageIO_FOUND}")

if(RGS_ENABLE_OPENIMAGEIO AND NOT OpenImageIO_FOUND)
  message(FATAL_ERROR "RGS_ENABLE_OPENIMAGEIO is ON, but no OpenImageIO is found: install libopenimageio-dev (Debian 12).")
elseif(RGS_ENABLE_OPENIMAGEIO)
  message(STATUS "OpenEXR, TIFF: on (OpenImageIO)")
elseif(rgs_looked_for_openimageio)
  message(STATUS "OpenEXR, TIFF: off (no OpenImageIO: install libopenimageio-dev)")
else()
  message(STATUS "OpenEXR, TIFF: off (RGS_ENABLE_OPENIMAGEIO is OFF)")
endif()
