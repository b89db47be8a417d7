// url_clock.hpp - the clock of a source behind a web server; tests bring one of their own.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <chrono>
#include <functional>
#include <memory>
#include <string>

#include "rgs/byte_source.hpp"

namespace rgs::detail {

struct UrlClock {
  /// The source's thread asks once a turn, before it reads from connections: what has come by then is not late.
  std::function<std::chrono::steady_clock::time_point()> now = [] { return std::chrono::steady_clock::now(); };
  std::chrono::milliseconds most_pause = std::chrono::milliseconds::max();  ///< between two turns
};

/// rgs::open_url_source() by another clock. UrlOptions::connect_seconds goes by libcurl's clock as well.
Result<std::unique_ptr<ByteSource>> open_url_source(const std::string& url, const UrlOptions& options,
                                                    const UrlClock& clock);

}  // namespace rgs::detail
