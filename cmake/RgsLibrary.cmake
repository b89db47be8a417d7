# rgs_library(NAME): what the installed libraries rgs_NAME share, as rgs::NAME; shared ones with BUILD_SHARED_LIBS=ON.
# SPDX-License-Identifier: Apache-2.0
function(rgs_library name)
  add_library(rgs::${name} ALIAS rgs_${name})
  # Exported is what a public header declares in `namespace RGS_API rgs`. Objects are the same in
  # static and in shared libraries. Before 1.0 a minor version may break the ABI: CONTRIBUTING.md, "Versions and ABI".
  set_target_properties(rgs_${name} PROPERTIES EXPORT_NAME ${name} POSITION_INDEPENDENT_CODE ON
    CXX_VISIBILITY_PRESET hidden CUDA_VISIBILITY_PRESET hidden VISIBILITY_INLINES_HIDDEN ON DEFINE_SYMBOL ""
    VERSION ${PROJECT_VERSION} SOVERSION ${PROJECT_VERSION_MAJOR}.${PROJECT_VERSION_MINOR})
  get_target_property(type rgs_${name} TYPE)
  if(type STREQUAL "SHARED_LIBRARY")
    set_target_properties(rgs_${name} PROPERTIES INSTALL_RPATH "$ORIGIN")
    # Nothing is left for the programs to find, and static libraries inside keep to themselves.
    target_link_options(rgs_${name} PRIVATE -Wl,--no-undefined,--exclude-libs,ALL)
  endif()
endfunction()
