# RGS_ENABLE_VIEW: ON where cpp-httplib and libjpeg-turbo are found, OFF with a message where they are not. Of cpp-httplib, by pkg-config,
# which knows what Debian's library was built with: its classes have another layout without.
# SPDX-License-Identifier: Apache-2.0
if(NOT DEFINED RGS_ENABLE_VIEW OR RGS_ENABLE_VIEW)
  find_package(PkgConfig QUIET)
  if(PkgConfig_FOUND)
    # What http_server.cpp overrides is as in these versions.
    pkg_check_modules(HTTPLIB QUIET IMPORTED_TARGET GLOBAL cpp-httplib>=0.11 cpp-httplib<0.15)
    pkg_check_modules(TURBOJPEG QUIET IMPORTED_TARGET GLOBAL libturbojpeg)
  endif()
  set(rgs_looked_for_view TRUE)
  set(rgs_view_found ${HTTPLIB_FOUND})
  if(NOT TURBOJPEG_FOUND)
    set(rgs_view_found FALSE)
  endif()
endif()
option(RGS_ENABLE_VIEW "Build rgs-view, through cpp-httplib and libjpeg-turbo" "${rgs_view_found}")

set(rgs_view_packages "pkg-config, cpp-httplib 0.11 to 0.14 and libturbojpeg: install pkgconf libcpp-httplib-dev libturbojpeg0-dev")
if(RGS_ENABLE_VIEW AND NOT rgs_view_found)
  message(FATAL_ERROR "RGS_ENABLE_VIEW is ON, but rgs-view needs ${rgs_view_packages} (Debian 12).")
elseif(RGS_ENABLE_VIEW)
  message(STATUS "rgs-view: on (cpp-httplib ${HTTPLIB_cpp-httplib_VERSION})")
elseif(rgs_looked_for_view)
  message(STATUS "rgs-view: off (it needs ${rgs_view_packages})")
else()
  message(STATUS "rgs-view: off (RGS_ENABLE_VIEW is OFF)")
endif()
