# RGS_PRECOMPILE: the standard headers that most files include are parsed once a target. What is built so does not show a
# missing #include, hence off but where another preset builds the same files without.
# SPDX-License-Identifier: Apache-2.0
option(RGS_PRECOMPILE "Precompile standard headers; a missing #include does not show then" OFF)
set(RGS_PRECOMPILED_HEADERS <algorithm> <array> <cmath> <cstddef> <cstdint> <cstring> <filesystem> <fstream> <functional>
  <limits> <memory> <mutex> <optional> <set> <span> <sstream> <string> <string_view> <thread> <unordered_map> <utility> <vector>)

# rgs_precompile(TARGET [HEADER...]): those, and further headers. Files with flags of their own need
# SKIP_PRECOMPILE_HEADERS.
function(rgs_precompile target)
  if(RGS_PRECOMPILE AND TARGET ${target})
    target_precompile_headers(${target} PRIVATE ${RGS_PRECOMPILED_HEADERS} ${ARGN})
    # Without the time in it, ccache can tell that it is the same.
    target_compile_options(${target} PRIVATE "$<$<COMPILE_LANG_AND_ID:CXX,Clang>:SHELL:-Xclang -fno-pch-timestamp>")
  endif()
endfunction()
