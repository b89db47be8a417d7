// url_source.cpp - reads a file behind a web server by range requests, through libcurl.
// SPDX-License-Identifier: Apache-2.0
//
// One thread of the source runs libcurl, so that requests share connections (with HTTP/2 one). read() queues a request
// for it and waits. Requests run in a fixed number of slots; a failed one waits for its next turn and continues after
// its last byte.
#include <curl/curl.h>
#include <signal.h>
#include <unistd.h>

#include <algorithm>
#include <atomic>
#include <cerrno>
#include <chrono>
#include <climits>
#include <cmath>
#include <condition_variable>
#include <cstring>
#include <functional>
#include <limits>
#include <mutex>
#include <optional>
#include <random>
#include <stop_token>
#include <string>
#include <string_view>
#include <system_error>
#include <thread>
#include <utility>
#include <vector>

#include "rgs/byte_source.hpp"
#include "rgs/guard_memory.hpp"
#include "rgs/version.hpp"
#include "sources/http_answer.hpp"
#include "sources/url_clock.hpp"

namespace rgs {
namespace {

using Clock = std::chrono::steady_clock;
using std::chrono::duration_cast;
using std::chrono::milliseconds;

constexpr std::uint64_t kFirstBytes = 64 << 10;  // of the first request: head and tables of most files; kept
constexpr std::uint64_t kMostBytes =
    256 << 10;  // of a read, where there is a choice: small, so that the next one starts soon
constexpr std::size_t kMostHeadBytes = 64 << 10;  // of a response, with those of 1xx before it; servers send about 500
constexpr long kBufferBytes = 64 << 10;           // of libcurl, for each slot
constexpr const char* kLate = "the server takes longer than allowed to open the file";
constexpr const char* kLongHead = "the head of the server's answer is too long";
constexpr double kLongest = 86400;  // of all times, seconds

Clock::duration seconds(double s) {
  return duration_cast<Clock::duration>(std::chrono::duration<double>(s));
}

struct EasyDeleter {
  void operator()(CURL* easy) const { ::curl_easy_cleanup(easy); }
};
struct MultiDeleter {
  void operator()(CURLM* multi) const { ::curl_multi_cleanup(multi); }
};
struct AddressDeleter {
  void operator()(CURLU* address) const { ::curl_url_cleanup(address); }
};
struct TextDeleter {
  void operator()(char* text) const { ::curl_free(text); }
};
struct ListDeleter {
  void operator()(curl_slist* list) const { ::curl_slist_free_all(list); }
};

bool is_https(const std::string& url) {
  return is_url(url) && (url[4] == 's' || url[4] == 'S');
}

// An error message for libcurl's code, with advice where there is any.
const char* text_of(CURLcode code) {
  switch (code) {
    case CURLE_URL_MALFORMAT: return "is not a valid web address";
    case CURLE_COULDNT_RESOLVE_HOST: return "the server's name cannot be resolved";
    case CURLE_COULDNT_RESOLVE_PROXY: return "the name of the environment's proxy server cannot be resolved";
    case CURLE_COULDNT_CONNECT: return "the server refuses the connection";
    case CURLE_OPERATION_TIMEDOUT: return "the server does not respond in time";
    case CURLE_PEER_FAILED_VERIFICATION:
      return "the server's certificate is not trusted, or names another server; set UrlOptions::certificates to trust "
             "your own";
    case CURLE_SSL_CACERT_BADFILE: return "the file of trusted certificates cannot be read or is empty";
    case CURLE_OUT_OF_MEMORY:  // libcurl's code for a line longer than its buffer
      return "the head of the server's response is too long, or memory ran out";
    case CURLE_PARTIAL_FILE:
    case CURLE_GOT_NOTHING:
    case CURLE_RECV_ERROR:
    case CURLE_SEND_ERROR: return "the connection to the server broke";
    case CURLE_UNSUPPORTED_PROTOCOL:
    case CURLE_WEIRD_SERVER_REPLY: return "the server does not speak HTTP, or libcurl lacks HTTPS";
    default: return ::curl_easy_strerror(code);  // static text
  }
}

// Whether a retry may succeed.
bool is_transient(CURLcode code) {
  switch (code) {
    case CURLE_URL_MALFORMAT:
    case CURLE_UNSUPPORTED_PROTOCOL:
    case CURLE_WEIRD_SERVER_REPLY:
    case CURLE_OUT_OF_MEMORY:
    case CURLE_PEER_FAILED_VERIFICATION:
    case CURLE_SSL_CACERT_BADFILE:
    case CURLE_SSL_CERTPROBLEM:
    case CURLE_SSL_CIPHER:
    case CURLE_SSL_ISSUER_ERROR:
    case CURLE_SSL_INVALIDCERTSTATUS:
    case CURLE_SSL_PINNEDPUBKEYNOTMATCH: return false;
    default: return true;
  }
}

// A waiting read(), on its stack.
struct Request {
  std::uint64_t offset = 0;
  std::span<std::byte> out;
  bool opens = false;                   // the first request, which pins the file
  bool may_be_whole = false;            // accept a response with the whole file
  std::size_t done = 0, most_done = 0;  // bytes; the most of earlier attempts
  int failures = 0;                     // in a row without a new byte
  bool at_origin = false;               // ask where redirects start
  bool over_new_connection = false;
  Clock::time_point not_before{};
  Request* next = nullptr;  // in the queue
  bool finished = false;
  Status status;
  std::condition_variable wake;
};

// A request in flight.
struct Slot {
  std::unique_ptr<CURL, EasyDeleter> easy;
  Request* request = nullptr;
  detail::FilePin* pin = nullptr;          // the source's
  const Clock::time_point* now = nullptr;  // the source's
  Clock::duration stall{};
  Clock::time_point deadline;
  std::string url;
  int redirects = 0;
  // Of the response.
  detail::HttpAnswer answer;
  std::size_t head_bytes = 0;
  bool connected = false;
  bool accepted = false;  // it matches: its body goes to the request
  bool is_redirect = false;
  std::optional<Error> refusal;  // why it is neither

  void begin_answer() {
    answer = {};
    head_bytes = 0;
    connected = accepted = is_redirect = false;
    refusal.reset();
  }
};

// libcurl's callbacks. The last two end the transfer by returning another number than that of the bytes.

int on_connected(void* user, char*, char*, int, int) {
  auto& slot = *static_cast<Slot*>(user);
  slot.connected = true;
  slot.deadline = *slot.now + slot.stall;
  return CURL_PREREQFUNC_OK;
}

std::size_t on_head(char* data, std::size_t, std::size_t n, void* user) {
  auto& slot = *static_cast<Slot*>(user);
  if (slot.request == nullptr) return 0;
  Request& request = *slot.request;
  slot.head_bytes += n;
  if (slot.head_bytes > kMostHeadBytes) {
    slot.refusal = Error{Errc::read_failed, request.offset + request.done, kLongHead, kMostHeadBytes, slot.head_bytes};
    return 0;
  }
  const std::string_view line(data, n);
  slot.answer.add_line(line);
  if (!slot.answer.ends_head(line)) return n;
  // Not extended by each line, or a head could take forever.
  slot.deadline = *slot.now + slot.stall;
  slot.is_redirect = slot.answer.is_redirect();
  if (slot.is_redirect) return 0;  // a redirect's body is ignored
  if (request.opens) {
    const auto pin = detail::FilePin::of(slot.answer, request.out.size());
    if (pin) {
      *slot.pin = *pin;
      request.opens = false;
      request.may_be_whole = slot.answer.status() == 200;
      request.out = request.out.first(static_cast<std::size_t>(std::min<std::uint64_t>(pin->size, request.out.size())));
    } else {
      slot.refusal = pin.error();
    }
  } else {
    const Status s = slot.pin->check(slot.answer, request.offset + request.done, request.offset + request.out.size(),
                                     request.may_be_whole);
    if (!s) slot.refusal = s.error();
    if (s && slot.answer.status() == 200) request.done = 0;  // restart: the whole file comes in one response
  }
  slot.accepted = !slot.refusal;
  return slot.accepted && slot.answer.status() < 300 ? n : 0;  // an empty file has status 416
}

std::size_t on_body(char* data, std::size_t, std::size_t n, void* user) {
  auto& slot = *static_cast<Slot*>(user);
  if (slot.request == nullptr || !slot.accepted) return 0;
  slot.deadline = *slot.now + slot.stall;
  Request& request = *slot.request;
  const std::size_t taken = std::min(n, request.out.size() - request.done);
  if (taken > 0) std::memcpy(request.out.data() + request.done, data, taken);
  request.done += taken;
  return taken;  // stops receiving what exceeds the request
}

class UrlSource final : public ByteSource {
 public:
  UrlSource(const std::string& url, const UrlOptions& options, const detail::UrlClock& clock)
      : options_(options), clock_(clock), origin_(url), url_(url) {}
  ~UrlSource() override {
    cancel();
    if (thread_.joinable()) thread_.join();
  }
  UrlSource(const UrlSource&) = delete;
  UrlSource& operator=(const UrlSource&) = delete;

  Status open() {
    static std::once_flag once;  // for libraries whose own is not thread-safe
    static CURLcode ready = CURLE_FAILED_INIT;
    std::call_once(once, [] { ready = ::curl_global_init(CURL_GLOBAL_DEFAULT); });
    {
      const std::scoped_lock lock(mutex_);  // of cancel()
      multi_.reset(ready == CURLE_OK ? ::curl_multi_init() : nullptr);
    }
    if (!multi_) return detail::out_of_memory();
    // Ranges of compressed bytes would be different ones. No header goes to a proxy.
    head_.reset(::curl_slist_append(nullptr, "Accept-Encoding: identity"));
    if (!head_) return detail::out_of_memory();
    const auto n = static_cast<std::size_t>(options_.reads_at_once);
    ::curl_multi_setopt(multi_.get(), CURLMOPT_PIPELINING, CURLPIPE_MULTIPLEX);
    ::curl_multi_setopt(multi_.get(), CURLMOPT_MAX_TOTAL_CONNECTIONS, static_cast<long>(n));
    ::curl_multi_setopt(multi_.get(), CURLMOPT_MAXCONNECTS, static_cast<long>(n));  // kept even if few are used
    slots_ = std::vector<Slot>(n);
    for (Slot& slot : slots_) {
      if (Status s = set_up(slot); !s) return s;
    }
    beginning_.resize(kFirstBytes);
    try {
      thread_ = std::thread([this] { work(); });
    } catch (const std::system_error&) {
      return make_error(Errc::host_out_of_memory, Error::kNone, "no more threads can be started");
    }
    Request first;
    first.out = beginning_;
    first.opens = true;
    set_limit(options_.open_seconds);
    if (Status s = wait_for(first); !s) {
      Error error = s.error();
      if (error.code == Errc::read_failed) error.code = Errc::open_failed;
      error.offset = Error::kNone;
      return tl::unexpected(error);
    }
    beginning_.resize(first.done);
    set_limit(std::numeric_limits<double>::infinity());
    return {};
  }

  std::uint64_t size() const override { return pin_.size; }

  Status read(std::uint64_t offset, std::span<std::byte> out) override {
    if (offset > size() || out.size() > size() - offset) {
      return make_error(Errc::read_failed, offset, "the file ends before the requested range", out.size(),
                        size() - std::min(offset, size()));
    }
    if (cancelled_) return cancelled(offset);
    if (offset < beginning_.size()) {
      const std::size_t n = std::min<std::size_t>(out.size(), beginning_.size() - static_cast<std::size_t>(offset));
      std::copy_n(beginning_.begin() + static_cast<std::ptrdiff_t>(offset), n, out.begin());
      offset += n;
      out = out.subspan(n);
    }
    if (out.empty()) return {};
    Request request;
    request.offset = offset;
    request.out = out;
    return wait_for(request);
  }

  void cancel() noexcept override {
    const std::scoped_lock lock(mutex_);
    cancelled_ = true;
    if (multi_) ::curl_multi_wakeup(multi_.get());
  }

  void set_limit(double seconds) override {
    const std::scoped_lock lock(mutex_);
    limit_ = seconds;
    if (multi_) ::curl_multi_wakeup(multi_.get());
  }

  Traits traits() const override {
    Traits traits;
    traits.reads_at_once = options_.reads_at_once;
    traits.most_bytes = kMostBytes;
    return traits;
  }

 private:
  static tl::unexpected<Error> cancelled(std::uint64_t offset) {
    return make_error(Errc::cancelled, offset, "reading was cancelled");
  }

  Status set_up(Slot& slot) {
    slot.easy.reset(::curl_easy_init());
    if (!slot.easy) return detail::out_of_memory();
    slot.pin = &pin_;
    slot.now = &now_;
    slot.stall = seconds(options_.stall_seconds);
    bool done = true;
    const auto set = [&](CURLoption option, auto value) {
      done &= ::curl_easy_setopt(slot.easy.get(), option, value) == CURLE_OK;
    };
    set(CURLOPT_PRIVATE, &slot);
    set(CURLOPT_NOSIGNAL, 1L);
    set(CURLOPT_PROTOCOLS_STR, "http,https");
    set(CURLOPT_FOLLOWLOCATION, 0L);  // follow() checks where redirects may lead
    set(CURLOPT_HTTP_VERSION, static_cast<long>(CURL_HTTP_VERSION_2TLS));
    set(CURLOPT_HTTP_CONTENT_DECODING, 0L);
    set(CURLOPT_HTTPHEADER, head_.get());
    set(CURLOPT_HEADEROPT, static_cast<long>(CURLHEADER_SEPARATE));
    set(CURLOPT_SUPPRESS_CONNECT_HEADERS, 1L);
    set(CURLOPT_USERAGENT, "roofgs/" RGS_VERSION);
    set(CURLOPT_NETRC, static_cast<long>(CURL_NETRC_IGNORED));
    set(CURLOPT_SSL_VERIFYPEER, 1L);
    set(CURLOPT_SSL_VERIFYHOST, 2L);
    if (!options_.certificates.empty()) set(CURLOPT_CAINFO, options_.certificates.c_str());
    set(CURLOPT_CONNECTTIMEOUT_MS, static_cast<long>(std::ceil(options_.connect_seconds * 1000)));
    set(CURLOPT_TCP_KEEPALIVE, 1L);
    set(CURLOPT_BUFFERSIZE, kBufferBytes);
    set(CURLOPT_PREREQFUNCTION, &on_connected);
    set(CURLOPT_PREREQDATA, &slot);
    set(CURLOPT_HEADERFUNCTION, &on_head);
    set(CURLOPT_HEADERDATA, &slot);
    set(CURLOPT_WRITEFUNCTION, &on_body);
    set(CURLOPT_WRITEDATA, &slot);
#if LIBCURL_VERSION_NUM >= 0x075700
    // Closing the source must not wait for a name lookup. The library may be older than its header.
    ::curl_easy_setopt(slot.easy.get(), CURLOPT_QUICK_EXIT, 1L);
#endif
    return done ? Status{} : detail::out_of_memory();
  }

  Status wait_for(Request& request) {
    std::unique_lock lock(mutex_);
    if (cancelled_) return cancelled(request.offset);
    append(arrived_, &request);
    ::curl_multi_wakeup(multi_.get());
    request.wake.wait(lock, [&] { return request.finished; });
    return request.status;
  }

  // From here on: on the source's thread.

  void work() {
    // A write to a closed connection must not end the program; libcurl misses rare cases.
    sigset_t pipe;
    ::sigemptyset(&pipe);
    ::sigaddset(&pipe, SIGPIPE);
    ::pthread_sigmask(SIG_BLOCK, &pipe, nullptr);
    for (;;) {
      now_ = clock_.now();
      take_arrived();
      if (cancelled_) break;
      start_waiting();
      int n_running = 0;
      ::curl_multi_perform(multi_.get(), &n_running);
      int n_left = 0;
      while (const CURLMsg* message = ::curl_multi_info_read(multi_.get(), &n_left)) {
        if (message->msg != CURLMSG_DONE) continue;
        char* slot = nullptr;
        ::curl_easy_getinfo(message->easy_handle, CURLINFO_PRIVATE, &slot);
        ended(*reinterpret_cast<Slot*>(slot), message->data.result);
      }
      for (Slot& slot : slots_) {
        if (slot.request != nullptr && slot.deadline <= now_) stalled(slot);
      }
      if (until_ <= now_) end_late_ones();
      ::curl_multi_poll(multi_.get(), nullptr, 0, pause_ms(), nullptr);
    }
    take_arrived();  // the last ones: none is queued after cancel()
    // Readers first: ending a transfer may wait for a name lookup.
    for (Slot& slot : slots_) {
      if (Request* request = std::exchange(slot.request, nullptr)) finish(*request, cancelled(request->offset));
    }
    while (Request* request = std::exchange(waiting_, waiting_ != nullptr ? waiting_->next : nullptr)) {
      finish(*request, cancelled(request->offset));
    }
    for (Slot& slot : slots_) {
      ::curl_multi_remove_handle(multi_.get(), slot.easy.get());
      slot.easy.reset();
    }
    std::unique_ptr<CURLM, MultiDeleter> last;
    const std::scoped_lock lock(mutex_);  // of cancel()
    last.swap(multi_);
  }

  void take_arrived() {
    const std::scoped_lock lock(mutex_);
    append(waiting_, std::exchange(arrived_, nullptr));
    if (limit_) until_ = *limit_ <= kLongest ? now_ + seconds(*limit_) : Clock::time_point::max();
    limit_.reset();
  }

  static void append(Request*& queue, Request* last) {
    Request** end = &queue;
    while (*end != nullptr) end = &(*end)->next;
    *end = last;
  }

  // Milliseconds until something is due without an event of the network.
  int pause_ms() {
    auto due = Clock::time_point::max();
    bool slot_free = false;
    for (const Slot& slot : slots_) {
      if (slot.request == nullptr) {
        slot_free = true;
      } else {
        due = std::min({due, until_, slot.deadline});
      }
    }
    if (waiting_ != nullptr) due = std::min(due, until_);
    for (const Request* request = waiting_; slot_free && request != nullptr; request = request->next) {
      due = std::min(due, request->not_before);
    }
    auto left = clock_.most_pause;
    if (due != Clock::time_point::max()) left = std::min(left, std::chrono::ceil<milliseconds>(due - now_));
    return static_cast<int>(std::clamp<std::int64_t>(left.count(), 0, INT_MAX));
  }

  void start_waiting() {
    for (Slot& slot : slots_) {
      if (slot.request != nullptr || until_ <= now_) continue;
      Request** at = &waiting_;
      while (*at != nullptr && (*at)->not_before > now_) at = &(*at)->next;
      if (*at == nullptr) return;
      Request& request = **at;
      *at = std::exchange(request.next, nullptr);
      slot.request = &request;
      const Status started = detail::guard_memory([&]() -> Status {
        slot.url = request.at_origin ? origin_ : url_;
        slot.redirects = 0;
        return start(slot);
      });
      if (!started) release(slot, started);
    }
  }

  Status start(Slot& slot) {
    const Request& request = *slot.request;
    CURL* easy = slot.easy.get();
    const std::string range =
        std::to_string(request.offset + request.done) + "-" + std::to_string(request.offset + request.out.size() - 1);
    // Streams of one connection wait until it is established; HTTP/1 has no streams.
    const long wait_for_pipe = is_https(slot.url) ? 1 : 0;
    if (::curl_easy_setopt(easy, CURLOPT_URL, slot.url.c_str()) != CURLE_OK ||
        ::curl_easy_setopt(easy, CURLOPT_RANGE, range.c_str()) != CURLE_OK ||
        ::curl_easy_setopt(easy, CURLOPT_PIPEWAIT, wait_for_pipe) != CURLE_OK ||
        // Avoid a connection that may be dead.
        ::curl_easy_setopt(easy, CURLOPT_FRESH_CONNECT, request.over_new_connection ? 1L : 0L) != CURLE_OK ||
        ::curl_easy_setopt(easy, CURLOPT_FORBID_REUSE, 0L) != CURLE_OK) {
      return detail::out_of_memory();
    }
    slot.begin_answer();
    slot.deadline = now_ + seconds(options_.connect_seconds);
    return ::curl_multi_add_handle(multi_.get(), easy) == CURLM_OK ? Status{} : detail::out_of_memory();
  }

  void stalled(Slot& slot) {
    // The connection may be dead unnoticed; the last transfer over it closes it.
    ::curl_easy_setopt(slot.easy.get(), CURLOPT_FORBID_REUSE, 1L);
    ended(slot, CURLE_OPERATION_TIMEDOUT);
  }

  void end_late_ones() {
    const auto late = [](const Request& request) {
      return make_error(Errc::read_failed, request.offset + request.done, kLate);
    };
    // Readers first: ending a transfer may wait for a name lookup.
    for (Slot& slot : slots_) {
      if (slot.request == nullptr) continue;
      release(slot, late(*slot.request));
      ::curl_easy_setopt(slot.easy.get(), CURLOPT_FORBID_REUSE, 1L);  // the rest of the answer still comes
      ::curl_multi_remove_handle(multi_.get(), slot.easy.get());
    }
    while (Request* request = std::exchange(waiting_, waiting_ != nullptr ? waiting_->next : nullptr)) {
      finish(*request, late(*request));
    }
  }

  // A transfer has ended, successfully or not.
  void ended(Slot& slot, CURLcode code) {
    const Status s = detail::guard_memory([&]() -> Status {
      Request& request = *slot.request;
      std::string target;
      curl_header* location = nullptr;
      if (slot.is_redirect &&
          ::curl_easy_header(slot.easy.get(), "Location", 0, CURLH_HEADER, -1, &location) == CURLHE_OK) {
        target = location->value;
      }
      curl_off_t retry_after = 0;
      ::curl_easy_getinfo(slot.easy.get(), CURLINFO_RETRY_AFTER, &retry_after);
      long system = 0;
      ::curl_easy_getinfo(slot.easy.get(), CURLINFO_OS_ERRNO, &system);
      ::curl_multi_remove_handle(multi_.get(), slot.easy.get());
      if (slot.is_redirect) return follow(slot, target);
      // All bytes have come, however the transfer ended.
      if (slot.accepted && request.done == request.out.size()) {
        if (request.at_origin || slot.redirects > 0) url_ = slot.url;
        release(slot, {});
        return {};
      }
      if (slot.refusal) {
        if (slot.answer.is_transient()) return retry(slot, *slot.refusal, static_cast<double>(retry_after));
        // The target of a redirect may be an address that expires, such as a signed one.
        const int status = slot.answer.status();
        const bool gone = status == 401 || status == 403 || status == 404 || status == 410;
        if (!gone || request.at_origin || url_ == origin_) return tl::unexpected(*slot.refusal);
        request.at_origin = true;
        requeue(slot, now_);
        return {};
      }
      Error error{.code = Errc::read_failed, .offset = request.offset + request.done, .what = text_of(code)};
      if (code == CURLE_OK) error.what = text_of(CURLE_PARTIAL_FILE);
      if (code == CURLE_COULDNT_CONNECT) error.system = static_cast<int>(system);
      // A server that could not be reached at the start is more likely a wrong address than a transient failure.
      if (!is_transient(code) || (request.opens && !slot.connected)) return tl::unexpected(error);
      request.over_new_connection = true;
      return retry(slot, error, 0);
    });
    if (!s) release(slot, s);
  }

  Status follow(Slot& slot, const std::string& target) {
    const Request& request = *slot.request;
    const auto refuse = [&](const char* what) {
      return make_error(Errc::read_failed, request.offset + request.done, what, Error::kNone,
                        static_cast<std::uint64_t>(slot.answer.status()));
    };
    if (++slot.redirects > options_.most_redirects) return refuse("the server redirects too often");
    const std::unique_ptr<CURLU, AddressDeleter> address(::curl_url());
    if (!address) return detail::out_of_memory();
    char* text = nullptr;
    if (target.empty() || ::curl_url_set(address.get(), CURLUPART_URL, slot.url.c_str(), 0) != CURLUE_OK ||
        ::curl_url_set(address.get(), CURLUPART_URL, target.c_str(), CURLU_URLENCODE) != CURLUE_OK ||
        ::curl_url_get(address.get(), CURLUPART_URL, &text, 0) != CURLUE_OK) {
      return refuse("the server redirects to an invalid web address");
    }
    const std::unique_ptr<char, TextDeleter> owner(text);
    std::string next(text);
    if (!is_url(next)) return refuse("the server redirects to an invalid web address");
    if (is_https(slot.url) && !is_https(next))
      return refuse("the server redirects from https to http, which is not secure");
    slot.url = std::move(next);
    return start(slot);
  }

  // Schedules a retry, or fails.
  Status retry(Slot& slot, const Error& error, double retry_after) {
    Request& request = *slot.request;
    if (request.done > request.most_done) request.failures = 0;
    request.most_done = std::max(request.most_done, request.done);
    if (request.failures >= options_.retries) return tl::unexpected(error);
    const double random = std::uniform_real_distribution<double>()(random_);
    requeue(slot, now_ + seconds(detail::retry_pause(request.failures++, retry_after, random)));
    return {};
  }

  void requeue(Slot& slot, Clock::time_point not_before) {
    slot.request->not_before = not_before;
    append(waiting_, std::exchange(slot.request, nullptr));
  }

  void release(Slot& slot, const Status& status) {
    if (Request* request = std::exchange(slot.request, nullptr)) finish(*request, status);
  }

  void finish(Request& request, const Status& status) {
    const std::scoped_lock lock(mutex_);
    request.status = status;
    request.finished = true;
    request.wake.notify_one();  // before the reader may see `finished` and destroy the request
  }

  const UrlOptions options_;
  const detail::UrlClock clock_;
  const std::string origin_;
  detail::FilePin pin_;               // set by the first request, before any other
  std::vector<std::byte> beginning_;  // the first bytes of the file
  std::unique_ptr<CURLM, MultiDeleter> multi_;
  std::unique_ptr<curl_slist, ListDeleter> head_;

  std::mutex mutex_;  // of these three, and of Request::finished
  std::atomic<bool> cancelled_{false};
  Request* arrived_ = nullptr;
  std::optional<double> limit_;  // set_limit()'s, until the thread sees it

  Clock::time_point now_{};                             // of this turn
  Clock::time_point until_ = Clock::time_point::max();  // end of the limit
  std::string url_;                                     // where redirects led
  std::vector<Slot> slots_;
  Request* waiting_ = nullptr;
  std::minstd_rand random_;
  std::thread thread_;
  const std::stop_callback<std::function<void()>> stop_{options_.stop,
                                                        [this] { UrlSource::cancel(); }};  // may come at once
};

bool in_range(const UrlOptions& o) {
  const auto is_time = [](double s) { return s > 0 && s <= kLongest; };
  return o.reads_at_once >= 1 && o.reads_at_once <= 64 && o.retries >= 0 && o.most_redirects >= 0 &&
         is_time(o.open_seconds) && is_time(o.connect_seconds) && is_time(o.stall_seconds);
}

}  // namespace

Result<std::unique_ptr<ByteSource>> open_url_source(const std::string& url, const UrlOptions& options) {
  return detail::open_url_source(url, options, {});
}

Result<std::unique_ptr<ByteSource>> detail::open_url_source(const std::string& url, const UrlOptions& options,
                                                            const UrlClock& clock) {
  return detail::guard_memory([&]() -> Result<std::unique_ptr<ByteSource>> {
    const auto refuse = [](const char* what) { return make_error(Errc::bad_argument, Error::kNone, what); };
    if (!in_range(options)) return refuse("an option of UrlOptions is out of range");
    if (!is_url(url)) return refuse("a web address begins with http:// or https://");
    const std::unique_ptr<CURLU, AddressDeleter> address(::curl_url());
    if (!address) return detail::out_of_memory();
    if (::curl_url_set(address.get(), CURLUPART_URL, url.c_str(), 0) != CURLUE_OK)
      return refuse("is not a valid web address");
    if (!options.certificates.empty() && ::access(options.certificates.c_str(), R_OK) != 0) {
      return make_error(Errc::open_failed, Error::kNone, "cannot read the file of trusted certificates", Error::kNone,
                        Error::kNone, errno);
    }
    auto source = std::make_unique<UrlSource>(url, options, clock);
    if (Status s = source->open(); !s) return tl::unexpected(s.error());
    return source;
  });
}

}  // namespace rgs
