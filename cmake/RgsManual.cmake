# RGS_MANUAL: man pages and completions for bash, zsh and fish, made by each build from the programs' --help.
# SPDX-License-Identifier: Apache-2.0
option(RGS_MANUAL "Make and install man pages and shell completions; needs Python" OFF)
if(NOT RGS_MANUAL)
  return()
endif()
find_package(Python3 3.9 REQUIRED COMPONENTS Interpreter)
set(rgs_manual_folder ${PROJECT_BINARY_DIR}/manual)
set(rgs_manual_programs "")
foreach(program IN LISTS RGS_INSTALLED_PROGRAMS)
  list(APPEND rgs_manual_programs $<TARGET_FILE:${program}>)
endforeach()
add_custom_command(OUTPUT ${rgs_manual_folder}/made VERBATIM
  COMMAND ${CMAKE_COMMAND} -E rm -rf ${rgs_manual_folder}
  COMMAND ${CMAKE_COMMAND} -E env LD_LIBRARY_PATH=${CMAKE_LIBRARY_OUTPUT_DIRECTORY}
    ${Python3_EXECUTABLE} ${PROJECT_SOURCE_DIR}/packaging/manual.py ${rgs_manual_folder} ${rgs_manual_programs}
  COMMAND ${CMAKE_COMMAND} -E touch ${rgs_manual_folder}/made
  DEPENDS ${PROJECT_SOURCE_DIR}/packaging/manual.py ${RGS_INSTALLED_PROGRAMS}
  COMMENT "Making man pages and completions")
add_custom_target(rgs_manual ALL DEPENDS ${rgs_manual_folder}/made)

install(DIRECTORY ${rgs_manual_folder}/man1 DESTINATION ${CMAKE_INSTALL_MANDIR} COMPONENT programs)
install(DIRECTORY ${rgs_manual_folder}/bash/ DESTINATION ${CMAKE_INSTALL_DATADIR}/bash-completion/completions COMPONENT programs)
install(DIRECTORY ${rgs_manual_folder}/fish/ DESTINATION ${CMAKE_INSTALL_DATADIR}/fish/vendor_completions.d COMPONENT programs)
# Debian's zsh looks in a folder of its own for what packages bring.
if(CMAKE_INSTALL_PREFIX STREQUAL "/usr" AND EXISTS /etc/debian_version)
  set(rgs_zsh_folder vendor-completions)
else()
  set(rgs_zsh_folder site-functions)
endif()
install(DIRECTORY ${rgs_manual_folder}/zsh/ DESTINATION ${CMAKE_INSTALL_DATADIR}/zsh/${rgs_zsh_folder} COMPONENT programs)
