# Builds the checkout that contains this port: vcpkg install roofgs --overlay-ports=packaging/vcpkg
# SPDX-License-Identifier: Apache-2.0
get_filename_component(SOURCE_PATH "${CMAKE_CURRENT_LIST_DIR}/../../.." ABSOLUTE)
vcpkg_check_features(OUT_FEATURE_OPTIONS options FEATURES
  http RGS_ENABLE_HTTP
  runtime RGS_BUILD_RUNTIME
  tools RGS_PROGRAMS)
# The build needs the target zstd::libzstd_shared.
vcpkg_check_linkage(ONLY_DYNAMIC_LIBRARY)
vcpkg_cmake_configure(SOURCE_PATH "${SOURCE_PATH}" OPTIONS
  ${options} -DRGS_ENABLE_CUDA=OFF -DRGS_ENABLE_OPENIMAGEIO=OFF -DRGS_BUILD_TESTS=OFF -DRGS_WERROR=OFF)
vcpkg_cmake_install()
vcpkg_cmake_config_fixup(PACKAGE_NAME rgs CONFIG_PATH lib/cmake/rgs)
vcpkg_fixup_pkgconfig()
if("tools" IN_LIST FEATURES)
  vcpkg_copy_tools(TOOL_NAMES rgs-audit rgs-convert rgs-diff rgs-info rgs-judge rgs-make-scene rgs-prune rgs-render AUTO_CLEAN)
endif()
file(REMOVE_RECURSE "${CURRENT_PACKAGES_DIR}/debug/include" "${CURRENT_PACKAGES_DIR}/debug/bin")
vcpkg_install_copyright(FILE_LIST "${SOURCE_PATH}/LICENSE")
