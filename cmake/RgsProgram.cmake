# rgs_program(NAME MAIN...): a command-line program with its arguments' parser.
# SPDX-License-Identifier: Apache-2.0
function(rgs_program name)
  add_executable(${name} ${ARGN})
  target_link_libraries(${name} PRIVATE CLI11::CLI11 rgs_compile_options)
  # Command-line parsing is templates on templates; optimising it costs a minute and gains nothing.
  set_source_files_properties(${ARGN} PROPERTIES COMPILE_OPTIONS "$<$<CONFIG:Release>:-O1>;$<$<CONFIG:Debug>:-O0>")
endfunction()
