# rgs_program(NAME MAIN...): a command-line program with its arguments' parser.
# rgs_program_library(NAME SOURCE...): what several programs share, for nobody else.
# SPDX-License-Identifier: Apache-2.0
function(rgs_program name)
  add_executable(${name} ${ARGN})
  target_link_libraries(${name} PRIVATE CLI11::CLI11 rgs_compile_options)
  # Command-line parsing is templates on templates; optimising it for speed costs a minute and a fifth more bytes.
  set_source_files_properties(${ARGN} PROPERTIES COMPILE_OPTIONS "$<$<CONFIG:Release>:-Os>;$<$<CONFIG:Debug>:-O0>")
endfunction()

# BUILD_SHARED_LIBS=ON takes one copy for each program off a bundle.
function(rgs_program_library name)
  add_library(${name} ${ARGN})
  if(BUILD_SHARED_LIBS)
    set_target_properties(${name} PROPERTIES VISIBILITY_INLINES_HIDDEN ON SOVERSION ${PROJECT_VERSION} INSTALL_RPATH "$ORIGIN")
    target_link_options(${name} PRIVATE -Wl,--no-undefined)
    if(RGS_INSTALL)
      install(TARGETS ${name} LIBRARY DESTINATION ${CMAKE_INSTALL_LIBDIR} COMPONENT programs NAMELINK_SKIP)
    endif()
  endif()
endfunction()
