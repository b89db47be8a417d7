# FindOpenImageIO - target OpenImageIO::OpenImageIO from headers and libraries alone. Debian's own package
# configuration stops unless its command-line programs and Imath's Python bindings are installed as well.
# SPDX-License-Identifier: Apache-2.0
find_path(OPENIMAGEIO_INCLUDE_DIR OpenImageIO/imageio.h)
find_library(OPENIMAGEIO_LIBRARY OpenImageIO)
find_library(OPENIMAGEIO_UTIL_LIBRARY OpenImageIO_Util)
mark_as_advanced(OPENIMAGEIO_INCLUDE_DIR OPENIMAGEIO_LIBRARY OPENIMAGEIO_UTIL_LIBRARY)
include(FindPackageHandleStandardArgs)
find_package_handle_standard_args(OpenImageIO
  REQUIRED_VARS OPENIMAGEIO_LIBRARY OPENIMAGEIO_UTIL_LIBRARY OPENIMAGEIO_INCLUDE_DIR)
if(OpenImageIO_FOUND AND NOT TARGET OpenImageIO::OpenImageIO)
  add_library(OpenImageIO::OpenImageIO UNKNOWN IMPORTED)
  set_target_properties(OpenImageIO::OpenImageIO PROPERTIES
    IMPORTED_LOCATION "${OPENIMAGEIO_LIBRARY}"
    INTERFACE_LINK_LIBRARIES "${OPENIMAGEIO_UTIL_LIBRARY}"
    INTERFACE_INCLUDE_DIRECTORIES "${OPENIMAGEIO_INCLUDE_DIR}")
endif()
