# rgs_compile_options: warnings, sanitizers and floating-point rules of our own targets; never exported.
# SPDX-License-Identifier: Apache-2.0
add_library(rgs_compile_options INTERFACE)
target_compile_features(rgs_compile_options INTERFACE cxx_std_20)
# -ffp-contract=off: a*b+c rounds twice everywhere, so that gcc, clang, Debug and Release give the same bits.
target_compile_options(rgs_compile_options INTERFACE
  $<$<COMPILE_LANGUAGE:CXX>:-Wall -Wextra -Wpedantic -Wshadow -Wconversion -Wsign-conversion -Wno-unknown-warning-option -ffp-contract=off>
  $<$<AND:$<COMPILE_LANGUAGE:CXX>,$<BOOL:${RGS_WERROR}>>:-Werror>)
if(RGS_SANITIZE)
  target_compile_options(rgs_compile_options INTERFACE
    $<$<COMPILE_LANGUAGE:CXX>:-fsanitize=${RGS_SANITIZE} -fno-sanitize-recover=all -fno-omit-frame-pointer>)
  target_link_options(rgs_compile_options INTERFACE -fsanitize=${RGS_SANITIZE})
endif()
