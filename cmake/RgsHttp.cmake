# RGS_ENABLE_HTTP: ON where a libcurl is found that is new enough, OFF with a message where none is.
# SPDX-License-Identifier: Apache-2.0
if(NOT DEFINED RGS_ENABLE_HTTP OR RGS_ENABLE_HTTP)
  find_package(CURL 7.85 QUIET)  # CURLOPT_PROTOCOLS_STR
  set(rgs_looked_for_curl TRUE)
endif()
option(RGS_ENABLE_HTTP "Read scenes from web servers, through libcurl" "${CURL_FOUND}")

if(RGS_ENABLE_HTTP AND NOT CURL_FOUND)
  message(FATAL_ERROR "RGS_ENABLE_HTTP is ON, but no libcurl of version 7.85 or later is found: install libcurl4-openssl-dev (Debian 12).")
elseif(RGS_ENABLE_HTTP)
  message(STATUS "HTTP: on (libcurl ${CURL_VERSION_STRING})")
elseif(rgs_looked_for_curl)
  message(STATUS "HTTP: off (no libcurl of version 7.85 or later: install libcurl4-openssl-dev)")
else()
  message(STATUS "HTTP: off (RGS_ENABLE_HTTP is OFF)")
endif()
