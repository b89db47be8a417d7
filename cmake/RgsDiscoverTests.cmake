# Makes each test case of a doctest program a ctest test after the program is linked:
#   rgs_discover_tests(TARGET LABEL)   -> tests "LABEL: test case"
# Cases are selected by their number in --list-test-cases, so that a name may hold any character; doctest's own module
# selects by name, which breaks at ';' and ','. Names must differ within a program. A test that skips (tests/support/skip.hpp)
# ends with 77, unless something in it failed. The longest ones begin first: at the end they would run alone.
# SPDX-License-Identifier: Apache-2.0
if(NOT CMAKE_SCRIPT_MODE_FILE)
  set(RGS_DISCOVER_TESTS_SCRIPT ${CMAKE_CURRENT_LIST_FILE})
  function(rgs_discover_tests target label)
    set(tests ${CMAKE_CURRENT_BINARY_DIR}/${target}-tests.cmake)
    add_custom_command(TARGET ${target} POST_BUILD BYPRODUCTS ${tests} VERBATIM
      COMMAND ${CMAKE_COMMAND} -D PROGRAM=$<TARGET_FILE:${target}> -D LABEL=${label} -D TESTS=${tests}
        -D "RUNNER=${CMAKE_CROSSCOMPILING_EMULATOR}" -P ${RGS_DISCOVER_TESTS_SCRIPT})
    # A program that was never built is a failing test, not a missing one.
    file(WRITE ${tests}.include "if(EXISTS \"${tests}\")\n  include(\"${tests}\")\nelse()\n"
      "  add_test(\"${label}: not built\" \"${target} is not built\")\nendif()\n")
    set_property(DIRECTORY APPEND PROPERTY TEST_INCLUDE_FILES ${tests}.include)
  endfunction()
  return()
endif()

list(APPEND RUNNER ${PROGRAM})
execute_process(COMMAND ${RUNNER} --list-test-cases --no-colors
  OUTPUT_VARIABLE listing ERROR_VARIABLE listing RESULT_VARIABLE status)
if(NOT status EQUAL 0)
  message(FATAL_ERROR "${PROGRAM} --list-test-cases: ${status}\n${listing}")
endif()
string(JOIN "|" slow
  "convert: --lod takes no more"
  "convert: a streamed conversion writes the bytes"
  "format: every single-byte change"
  "format: the reader's defaults accept files of equal"
  "lod: too little memory to sort"
  "memory: writing and reading levels"
  "motion: levels of detail do not pop"
  "programs: a program that gets no more memory"
  "programs: names and values from outside"
  "render: what a file declares"
  "runtime: a scene on a grid"
  "runtime: images of one pixel")
list(JOIN RUNNER "]==] [==[" words)
set(script "")
set(number 0)
set(seen "\n")
# Line by line without CMake lists: ';' and '[' mean something there.
while(listing MATCHES "^([^\n]*)\n(.*)$")
  set(name "${CMAKE_MATCH_1}")
  set(listing "${CMAKE_MATCH_2}")
  if(name MATCHES "^(\\[doctest\\]|====)" OR name STREQUAL "")
    continue()
  endif()
  math(EXPR number "${number} + 1")
  string(FIND "${seen}" "\n${name}\n" twice)
  if(NOT twice EQUAL -1)
    message(FATAL_ERROR "${PROGRAM}: two test cases are named '${name}'")
  endif()
  string(APPEND seen "${name}\n")
  # What counts instructions runs under valgrind, and has a label of its own.
  set(label ${LABEL})
  set(command "[==[${words}]==]")
  if(name MATCHES "^growth: (.*)")
    set(label growth)
    set(name "${LABEL}: ${CMAKE_MATCH_1}")
    set(command "sh [==[${CMAKE_CURRENT_LIST_DIR}/../tests/support/count_work.sh]==] ${command}")
  endif()
  set(cost "")
  if("${LABEL}: ${name}" MATCHES "^(${slow})")
    set(cost " COST 10")
  endif()
  string(APPEND script "add_test([==[${label}: ${name}]==] ${command} --first=${number} --last=${number})\n"
    "set_tests_properties([==[${label}: ${name}]==] PROPERTIES LABELS ${label} TIMEOUT 3600${cost}\n"
    "  ENVIRONMENT RGS_SKIP_RETURN_CODE=77 SKIP_RETURN_CODE 77)\n")
endwhile()
file(WRITE ${TESTS} "${script}")
