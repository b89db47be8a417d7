# RGS_ENABLE_VIEW: ON where Boost is found, OFF with a message where it is not.
# SPDX-License-Identifier: Apache-2.0
if(NOT DEFINED RGS_ENABLE_VIEW OR RGS_ENABLE_VIEW)
  find_package(Boost 1.74 QUIET CONFIG)
  set(rgs_looked_for_view TRUE)
endif()
option(RGS_ENABLE_VIEW "Build rgs-view, through Boost" "${Boost_FOUND}")

if(RGS_ENABLE_VIEW AND NOT Boost_FOUND)
  message(FATAL_ERROR "RGS_ENABLE_VIEW is ON, but no Boost of version 1.74 or later is found: install libboost-dev (Debian 12).")
elseif(RGS_ENABLE_VIEW)
  message(STATUS "rgs-view: on (Boost ${Boost_VERSION})")
elseif(rgs_looked_for_view)
  message(STATUS "rgs-view: off (no Boost of version 1.74 or later: install libboost-dev)")
else()
  message(STATUS "rgs-view: off (RGS_ENABLE_VIEW is OFF)")
endif()
