// tbb.hpp - what converter/ uses of oneTBB, on the caller's thread; build-wasm.sh puts it in the place of oneTBB's headers.
// Like those of oneTBB, results do not depend on how ranges are split: here they are not.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <concepts>
#include <cstddef>
#include <type_traits>

namespace tbb {

template <class T>
class blocked_range {
 public:
  blocked_range(T begin, T end, std::size_t = 1) : begin_(begin), end_(end) {}
  T begin() const { return begin_; }
  T end() const { return end_; }

 private:
  T begin_, end_;
};
struct simple_partitioner {};

template <std::integral T, class F>
void parallel_for(T first, T end, const F& f) {
  for (; first < end; ++first) f(first);
}
template <class T, class F>
void parallel_for(const blocked_range<T>& range, const F& f, simple_partitioner = {}) {
  if (range.begin() < range.end()) f(range);
}

template <class T>
class enumerable_thread_specific {
 public:
  explicit enumerable_thread_specific(const T& value) : value_(value) {}
  T& local() { return value_; }
  T* begin() { return &value_; }
  T* end() { return &value_ + 1; }

 private:
  T value_;
};

class spin_mutex {
 public:
  struct scoped_lock {
    explicit scoped_lock(spin_mutex&) {}
  };
};

class task_group {
 public:
  template <class F>
  void run(const F& f) {
    f();
  }
  void wait() {}
};

class task_arena {
 public:
  explicit task_arena(int) {}
  template <class F>
  void execute(const F& f) {
    f();
  }
};
namespace this_task_arena {
inline int max_concurrency() {
  return 1;
}
}  // namespace this_task_arena

enum class filter_mode { parallel, serial_in_order };
class flow_control {
 public:
  void stop() { stopped_ = true; }
  bool stopped() const { return stopped_; }

 private:
  bool stopped_ = false;
};
template <class In, class Out, class F>
struct filter {
  F f;
};
template <class In, class Out, class F>
filter<In, Out, F> make_filter(filter_mode, const F& f) {
  return {f};
}
template <class Between, class Out, class F, class G>
auto operator&(const filter<void, Between, F>& first, const filter<Between, Out, G>& then) {
  const auto both = [first, then](flow_control& control) -> Out {
    const Between item = first.f(control);
    if (!control.stopped()) return then.f(item);
    if constexpr (!std::is_void_v<Out>) return Out{};
  };
  return make_filter<void, Out>(filter_mode::serial_in_order, both);
}
template <class F>
void parallel_pipeline(std::size_t, const filter<void, void, F>& all) {
  for (flow_control control; !control.stopped();) all.f(control);
}

}  // namespace tbb
