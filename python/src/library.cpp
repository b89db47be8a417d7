// library.cpp - the entry points of the shared library that the package roofgs loads by ctypes.
// SPDX-License-Identifier: Apache-2.0
#include <map>
#include <memory>
#include <new>
#include <string>
#include <string_view>

#include "calls.hpp"
#include "console.hpp"
#include "rgs/version.hpp"
#include "work.hpp"

namespace rgs::python {
namespace {

using CallsByName = std::map<std::string_view, Json (*)(const Json&)>;

std::string reply(const char* name, const char* arguments);

// Calls `name` on a thread of its own, where no Python runs: its threads do not outlive the interpreter safely.
Json start(const Json& a) {
  const std::string name = a.at("function"), arguments = a.at("arguments");
  held<std::shared_ptr<Work>>(a, "work")->start([=] { return reply(name.c_str(), arguments.c_str()); });
  return nullptr;
}
Json wait(const Json& a) {
  return held<std::shared_ptr<Work>>(a, "work")->wait(a.at("seconds"));
}
Json reply_of(const Json& a) {
  return held<std::shared_ptr<Work>>(a, "work")->reply();
}

CallsByName all_calls() {
  CallsByName all{{"version", [](const Json&) -> Json { return RGS_VERSION; }},
                  {"start", start},
                  {"wait", wait},
                  {"reply_of", reply_of}};
  for (const Calls& calls : {camera_calls(), scene_calls(), stream_calls(), render_calls()})
    all.insert(calls.begin(), calls.end());
  return all;
}

std::string reply(const char* name, const char* arguments) {
  try {
    static const auto& calls =
        *new CallsByName(all_calls());  // never destroyed: daemon threads call while the process ends
    const Json value = calls.at(name)(Json::parse(arguments));
    return Json{{"value", value}}.dump(-1, ' ', true, Json::error_handler_t::replace);
  } catch (const Failure& failure) {
    return tool::error_message({}, failure.error, tool::describe(failure.error));
  } catch (const Cancelled&) {
    return tool::error_message({}, {.code = Errc::cancelled}, "given up");
  } catch (const std::bad_alloc&) {
    const Error error{.code = Errc::host_out_of_memory, .what = "out of memory"};
    return tool::error_message({}, error, error.what);
  } catch (const std::exception& e) {
    return tool::error_message({}, {.code = Errc::internal}, e.what());
  } catch (...) {
    return tool::error_message({}, {.code = Errc::internal}, "an exception of an unknown kind");
  }
}

}  // namespace
}  // namespace rgs::python

/// The reply, valid until this thread's next call: {"value": ...}, or {"error": ...} as of RGS_MESSAGES=json.
extern "C" __attribute__((visibility("default"))) const char* roofgs_call(const char* name, const char* arguments) {
  thread_local std::string text;
  text = rgs::python::reply(name, arguments);
  return text.c_str();
}

extern "C" __attribute__((visibility("default"))) void roofgs_free(void* handle) {
  delete static_cast<std::any*>(handle);
}
