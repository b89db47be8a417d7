# RGS_DEBIAN: `cpack -G DEB` makes the Debian packages roofgs, roofgs-pictures, libroofgs and libroofgs-dev, or, where the Python
# module is built, which holds its libraries, python3-roofgs. packaging/deb.sh configures all that belongs to it.
# SPDX-License-Identifier: Apache-2.0
option(RGS_DEBIAN "Prepare Debian packages; see packaging/deb.sh" OFF)
if(NOT RGS_DEBIAN)
  return()
endif()
if(NOT CMAKE_INSTALL_PREFIX STREQUAL "/usr" OR NOT RGS_BUILD_PYTHON AND NOT (BUILD_SHARED_LIBS AND RGS_MANUAL))
  message(FATAL_ERROR "RGS_DEBIAN needs CMAKE_INSTALL_PREFIX=/usr and BUILD_SHARED_LIBS and RGS_MANUAL, or RGS_BUILD_PYTHON: "
    "run packaging/deb.sh.")
endif()
set(RGS_MAINTAINER "RoofGS maintainers <maintainers@roofgs.invalid>" CACHE STRING "Maintainer that Debian packages name")

# The packages' version is that of debian/changelog, which must be a revision of the project's.
set(rgs_debian_folder ${PROJECT_SOURCE_DIR}/packaging/debian)
file(STRINGS ${rgs_debian_folder}/changelog rgs_changelog_head LIMIT_COUNT 1)
if(NOT rgs_changelog_head MATCHES "^roofgs \\(${PROJECT_VERSION}-([0-9]+)\\) ")
  message(FATAL_ERROR "packaging/debian/changelog begins with '${rgs_changelog_head}', not with version ${PROJECT_VERSION}.")
endif()
set(CPACK_DEBIAN_PACKAGE_RELEASE ${CMAKE_MATCH_1})
set(rgs_debian_version ${PROJECT_VERSION}-${CMAKE_MATCH_1})
configure_file(${rgs_debian_folder}/changelog ${PROJECT_BINARY_DIR}/debian/changelog.Debian COPYONLY)
execute_process(COMMAND gzip -9nkf ${PROJECT_BINARY_DIR}/debian/changelog.Debian COMMAND_ERROR_IS_FATAL ANY)

set(CPACK_PACKAGE_CONTACT "${RGS_MAINTAINER}")
set(CPACK_PACKAGE_VERSION ${PROJECT_VERSION})
set(CPACK_PACKAGE_DIRECTORY ${PROJECT_BINARY_DIR}/packages)
set(CPACK_PACKAGING_INSTALL_PREFIX /usr)
set(CPACK_INSTALL_DEFAULT_DIRECTORY_PERMISSIONS
  OWNER_READ OWNER_WRITE OWNER_EXECUTE GROUP_READ GROUP_EXECUTE WORLD_READ WORLD_EXECUTE)
set(CPACK_STRIP_FILES ON)
set(CPACK_DEB_COMPONENT_INSTALL ON)
set(CPACK_DEBIAN_FILE_NAME DEB-DEFAULT)
set(CPACK_DEBIAN_PACKAGE_CONTROL_STRICT_PERMISSION ON)
# Libraries of the system by dpkg-shlibdeps, those of one another by name and exact version.
set(CPACK_DEBIAN_PACKAGE_SHLIBDEPS ON)
set(CPACK_DEBIAN_PACKAGE_SHLIBDEPS_PRIVATE_DIRS ${CMAKE_LIBRARY_OUTPUT_DIRECTORY})
set(CPACK_DEBIAN_PACKAGE_GENERATE_SHLIBS ON)
set(CPACK_DEBIAN_PACKAGE_GENERATE_SHLIBS_POLICY "=")
set(CPACK_PACKAGE_DESCRIPTION_SUMMARY "")  # each package has its own
file(WRITE ${PROJECT_BINARY_DIR}/debian/triggers "activate-noawait ldconfig\n")
set(CPACK_DEBIAN_LIBRARIES_PACKAGE_CONTROL_EXTRA ${PROJECT_BINARY_DIR}/debian/triggers)
set(CPACK_DEBIAN_PROGRAMS_PACKAGE_CONTROL_EXTRA ${PROJECT_BINARY_DIR}/debian/triggers)
set(CPACK_COMPONENTS_ALL "")

# rgs_debian_package(COMPONENT PACKAGE SECTION SUMMARY DESCRIPTION [DEPENDS])
function(rgs_debian_package component package section summary description)
  list(JOIN ARGN ", " depends)
  string(TOUPPER ${component} key)
  foreach(setting "PACKAGE_NAME;${package}" "PACKAGE_SECTION;${section}" "PACKAGE_DEPENDS;${depends}"
      "DESCRIPTION;${summary}\n${description}")
    list(GET setting 0 name)
    list(GET setting 1 value)
    set(CPACK_DEBIAN_${key}_${name} "${value}" PARENT_SCOPE)
  endforeach()
  list(APPEND CPACK_COMPONENTS_ALL ${component})
  set(CPACK_COMPONENTS_ALL ${CPACK_COMPONENTS_ALL} PARENT_SCOPE)
  install(FILES ${rgs_debian_folder}/copyright ${PROJECT_BINARY_DIR}/debian/changelog.Debian.gz
    DESTINATION share/doc/${package} COMPONENT ${component})
  if(EXISTS ${rgs_debian_folder}/${package}.lintian-overrides)
    install(FILES ${rgs_debian_folder}/${package}.lintian-overrides
      DESTINATION share/lintian/overrides RENAME ${package} COMPONENT ${component})
  endif()
endfunction()

set(rgs_about "RoofGS turns a trained 3D Gaussian splatting scene into a compact file that a
GPU reads as it lies on disk, and renders it with the image that the original
3DGS code defines.")
if(RGS_BUILD_PYTHON)
  rgs_debian_package(python python3-roofgs python "3D Gaussian splat scenes: Python module"
    "${rgs_about}\n.\nThis package has the module roofgs for Python 3, which needs NumPy and no GPU."
    "python3 (>= 3.9)" "python3-numpy")
  set(CPACK_DEBIAN_PYTHON_PACKAGE_CONTROL_EXTRA ${rgs_debian_folder}/python/postinst ${rgs_debian_folder}/python/prerm)
  include(CPack)
  return()
endif()
rgs_debian_package(libraries libroofgs libs "3D Gaussian splat scenes: shared libraries"
  "${rgs_about}\n.\nThis package has the libraries that programs need to run: the file format, the\nformats of others, cameras and renderers.")
rgs_debian_package(development libroofgs-dev libdevel "3D Gaussian splat scenes: headers"
  "${rgs_about}\n.\nThis package has what programs in C++20 are built with: headers, the CMake\npackage rgs, and for pkg-config rgs-format, rgs-interchange, rgs-cameras and\nrgs-runtime."
  "libroofgs (= ${rgs_debian_version})" "libexpected-dev" "libglm-dev")
rgs_debian_package(programs roofgs graphics "3D Gaussian splat scenes: converter, audit and renderer"
  "${rgs_about}\n.\nThis package has the programs: rgs-convert, rgs-info, rgs-audit, rgs-diff,\nrgs-judge, rgs-prune, rgs-render, rgs-view and rgs-make-scene."
  "libroofgs (= ${rgs_debian_version})")
set(CPACK_DEBIAN_PROGRAMS_PACKAGE_SUGGESTS roofgs-pictures)
if(TARGET rgs_pictures)
  rgs_debian_package(pictures roofgs-pictures graphics "3D Gaussian splat scenes: pictures in more formats"
    "${rgs_about}\n.\nThis package lets the programs read and write OpenEXR, TIFF and other pictures\nthan PNG and JPEG, through OpenImageIO."
    "roofgs (= ${rgs_debian_version})")
endif()
include(CPack)
