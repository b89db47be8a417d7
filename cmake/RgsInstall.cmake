# Install rules, the CMake package rgs with the components format, interchange, cuda and runtime, and for pkg-config
# rgs-format, rgs-interchange, rgs-cameras and rgs-runtime. `cmake --install BUILD --component programs`, pictures,
# libraries (shared ones) or development installs a part; packages are made of these.
# SPDX-License-Identifier: Apache-2.0
include(CMakePackageConfigHelpers)
set(rgs_package_folder ${CMAKE_INSTALL_LIBDIR}/cmake/rgs)
set(rgs_pc_folder ${CMAKE_INSTALL_LIBDIR}/pkgconfig)

# Libraries by component, in the order of dependence. What is not built is not installed.
set(rgs_component_format rgs_format rgs_math)
set(rgs_component_interchange rgs_cameras rgs_interchange)
if(NOT BUILD_SHARED_LIBS)  # a shared rgs_runtime holds the kernels
  set(rgs_component_cuda rgs_kernels)
endif()
set(rgs_component_runtime rgs_runtime)

# Namespace of imported targets, package that an outside project must find to have them, module of pkg-config.
foreach(row "tl;tl-expected;" "TBB;TBB;tbb" "hwy;hwy;libhwy" "glm;glm;glm" "zstd;zstd;libzstd"
    "Threads;Threads;" "CUDA;CUDAToolkit;" "xxHash;xxHash;libxxhash" "ZLIB;ZLIB;zlib" "WebP;WebP;libwebp" "LibZip;LibZip;libzip"
    "CURL;CURL;libcurl")
  list(GET row 0 space)
  list(GET row 1 rgs_package_of_${space})
  list(GET row 2 rgs_pc_of_${space})
endforeach()

# What whoever links `target` must have: CMake's `packages` and, for pkg-config, modules (`requires`) and linker's
# arguments (`libs`). Static libraries pass on private ones too.
function(rgs_needs_of target)
  set(packages "")
  set(requires "")
  set(libs "")
  get_target_property(links ${target} INTERFACE_LINK_LIBRARIES)
  foreach(link IN LISTS links)
    if(link MATCHES "BUILD_INTERFACE" OR NOT link MATCHES "([A-Za-z_]+)::([A-Za-z_]+)")
      continue()
    endif()
    set(space ${CMAKE_MATCH_1})
    if(link MATCHES "rgs::(format|cameras)")
      list(APPEND requires rgs-${CMAKE_MATCH_1})
    elseif(link MATCHES "rgs::kernels")
      list(APPEND libs "-lrgs_kernels -L${CUDAToolkit_LIBRARY_DIR} -lcudart_static -lrt -ldl")
    elseif(space STREQUAL "rgs")
      continue()  # rgs::math comes with rgs-format
    elseif(NOT DEFINED rgs_package_of_${space})
      message(FATAL_ERROR "RgsInstall.cmake does not know which package has ${link}, linked by ${target}.")
    else()
      list(APPEND packages ${rgs_package_of_${space}})
      list(APPEND requires ${rgs_pc_of_${space}})
      if(space STREQUAL "Threads")
        list(APPEND libs -pthread)
      endif()
    endif()
  endforeach()
  list(JOIN requires " " requires)
  list(JOIN libs " " libs)
  set(packages ${packages} PARENT_SCOPE)
  set(requires "${requires}" PARENT_SCOPE)
  set(libs "${libs}" PARENT_SCOPE)
endfunction()

set(rgs_components "")
set(rgs_component_packages "")
foreach(component format interchange cuda runtime)
  set(component_packages "")
  set(targets "")
  foreach(target IN LISTS rgs_component_${component})
    if(TARGET ${target})
      list(APPEND targets ${target})
      rgs_needs_of(${target})
      list(APPEND component_packages ${packages})
      if(NOT target MATCHES "math|kernels")
        string(REPLACE "_" "-" module ${target})
        # Found from the file's own place, so that the folder installed to can be chosen late and moved.
        file(RELATIVE_PATH prefix /prefix/${rgs_pc_folder} /prefix)
        configure_file(cmake/library.pc.in ${PROJECT_BINARY_DIR}/${module}.pc @ONLY)
        install(FILES ${PROJECT_BINARY_DIR}/${module}.pc DESTINATION ${rgs_pc_folder} COMPONENT development)
      endif()
    endif()
  endforeach()
  if(NOT targets)
    continue()
  endif()
  list(REMOVE_DUPLICATES component_packages)
  list(APPEND rgs_components ${component})
  string(APPEND rgs_component_packages "set(rgs_packages_of_${component} ${component_packages})\n")
  install(TARGETS ${targets} EXPORT rgs-${component}
    ARCHIVE DESTINATION ${CMAKE_INSTALL_LIBDIR} COMPONENT development
    LIBRARY DESTINATION ${CMAKE_INSTALL_LIBDIR} COMPONENT libraries NAMELINK_COMPONENT development)
  install(EXPORT rgs-${component} NAMESPACE rgs:: DESTINATION ${rgs_package_folder} COMPONENT development)
endforeach()

set(RGS_INSTALLED_PROGRAMS "")
foreach(program rgs-convert rgs-info rgs-audit rgs-diff rgs-judge rgs-make-scene rgs-prune rgs-render rgs-bench
        rgs-bench-flight rgs-bench-opening rgs-view)
  if(TARGET ${program})
    list(APPEND RGS_INSTALLED_PROGRAMS ${program})
    install(TARGETS ${program} RUNTIME DESTINATION ${CMAKE_INSTALL_BINDIR} COMPONENT programs)
  endif()
endforeach()
if(TARGET rgs_pictures)
  install(TARGETS rgs_pictures LIBRARY DESTINATION ${CMAKE_INSTALL_LIBDIR}/roofgs COMPONENT pictures)
endif()
# The page that rgs-view serves, which scripts/build_page.sh builds.
if(TARGET rgs-view)
  install(CODE "if(NOT EXISTS \"${PROJECT_SOURCE_DIR}/web/viewer/dist-single/page.html\")
  message(WARNING \"rgs-view is installed without its page: sh ${PROJECT_SOURCE_DIR}/scripts/build_page.sh, then install again\")
endif()" COMPONENT programs)
  install(DIRECTORY web/viewer/dist/ DESTINATION ${CMAKE_INSTALL_DATADIR}/roofgs/viewer COMPONENT programs OPTIONAL)
  install(FILES web/viewer/dist-single/page.html RENAME single.html DESTINATION ${CMAKE_INSTALL_DATADIR}/roofgs/viewer
    COMPONENT programs OPTIONAL)
  # The page offers a sample that lies beside it.
  if(TARGET rgs-make-scene AND NOT CMAKE_CROSSCOMPILING)
    install(CODE "execute_process(COMMAND \"${CMAKE_COMMAND}\" -E env \"LD_LIBRARY_PATH=${CMAKE_LIBRARY_OUTPUT_DIRECTORY}\"
  sh \"${PROJECT_SOURCE_DIR}/scripts/make_sample.sh\" \"$<TARGET_FILE_DIR:rgs-make-scene>\" \"${PROJECT_BINARY_DIR}/sample.rgs\"
  COMMAND_ERROR_IS_FATAL ANY)" COMPONENT programs)
    install(FILES ${PROJECT_BINARY_DIR}/sample.rgs DESTINATION ${CMAKE_INSTALL_DATADIR}/roofgs/viewer COMPONENT programs)
  endif()
endif()
include(RgsManual)

foreach(row "rgs_format;format;*" "rgs_math;kernels/math;*" "rgs_cameras;runtime;camera*" "rgs_runtime;runtime;*"
    "rgs_interchange;converter/formats;*")
  list(GET row 0 target)
  list(GET row 1 folder)
  list(GET row 2 names)
  if(TARGET ${target})
    install(DIRECTORY ${folder}/include/ DESTINATION ${CMAKE_INSTALL_INCLUDEDIR} COMPONENT development
      FILES_MATCHING PATTERN "${names}.hpp")
  endif()
endforeach()

configure_package_config_file(cmake/rgsConfig.cmake.in ${PROJECT_BINARY_DIR}/rgsConfig.cmake
  INSTALL_DESTINATION ${rgs_package_folder} NO_SET_AND_CHECK_MACRO)
write_basic_package_version_file(${PROJECT_BINARY_DIR}/rgsConfigVersion.cmake COMPATIBILITY SameMinorVersion)
install(FILES ${PROJECT_BINARY_DIR}/rgsConfig.cmake ${PROJECT_BINARY_DIR}/rgsConfigVersion.cmake
  cmake/FindLibZip.cmake cmake/FindWebP.cmake cmake/FindxxHash.cmake DESTINATION ${rgs_package_folder}
  COMPONENT development)
include(RgsPackages)
