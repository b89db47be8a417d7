// trace_test.cpp - what a scheduler behind numbers is told and answers, as in tests/golden/pages. web/reader replays the
// same files.
// SPDX-License-Identifier: Apache-2.0
#include <doctest/doctest.h>

#include <algorithm>
#include <charconv>
#include <cmath>
#include <cstdint>
#include <cstdlib>
#include <iterator>
#include <optional>
#include <span>
#include <string>
#include <string_view>
#include <utility>
#include <vector>

#include "checkout.hpp"
#include "pages/wire.hpp"
#include "pages_world.hpp"
#include "text_file.hpp"

using namespace rgs;
using namespace rgs::test;
using pages::Wire;
using pages::WireAction;
using pages::WireEvent;
using pages::event::Fault;

namespace {

constexpr double kMillisecond = 1e6;

void put(std::string& text, double value) {
  char digits[400];  // the shortest that are read as this number
  text.append(digits, std::to_chars(std::begin(digits), std::end(digits), value, std::chars_format::fixed).ptr);
}

/// Lines of numbers: "setup", "page" for each page, and for each step "at TIME", its events and, behind ">", its actions.
class Trace {
 public:
  std::string text;

  /// The wire knows pages 0 .. n_known - 1.
  Trace(const Tree& tree, std::vector<double> setup, std::size_t n_known = ~std::size_t{0})
      : tree_(tree), known_(beginning_of(tree, n_known)), wire_(setup, numbers_of(known_, 0, known_.pages.size())) {
    line("setup", setup);
    const std::vector<double> all = numbers_of(known_, 0, known_.pages.size());
    for (std::size_t at = 0; at < all.size(); at += pages::kPageNumbers)
      line("page", std::span(all).subspan(at, pages::kPageNumbers));
    view = wire_.add_view();
  }

  /// Tells one event, and does what a driver would: keeps what readers are to do, and when they wake.
  template <class... T>
  void tell(WireEvent code, T... fields) {
    tell_all({static_cast<double>(code), static_cast<double>(fields)...});
  }
  void tell_all(const std::vector<double>& event) {
    const std::span<const double> actions = wire_.step(event, now);
    text += "at ";
    put(text, now);
    line("", event);
    text.pop_back();
    line(" >", actions);
    for (std::size_t at = 0; at < actions.size();) {
      const auto field = [&](std::size_t i) { return static_cast<std::uint32_t>(actions[at + i]); };
      switch (static_cast<WireAction>(actions[at])) {
        case WireAction::read:
          tasks.push_back({field(1), field(2)});
          at += 3;
          break;
        case WireAction::probe:
          tasks.push_back({0, 0});
          at += 1;
          break;
        case WireAction::read_table:
          tasks.push_back({field(1), kTable});
          at += 2;
          break;
        case WireAction::evict:
          ++n_evicted;
          at += 2;
          break;
        case WireAction::draw:
          drawn.assign(actions.begin() + static_cast<std::ptrdiff_t>(at) + 3,
                       actions.begin() + static_cast<std::ptrdiff_t>(at) + 3 + field(2));
          at += 3 + field(2);
          break;
        case WireAction::taken:
          has_taken = field(1) != 0;
          at += 2;
          break;
        case WireAction::wake_at:
          wakes = actions[at + 1];
          at += 2;
          break;
        case WireAction::wake:
          is_awake = true;
          at += 1;
          break;
      }
    }
  }
  void look(const std::vector<double>& position, double detail_px, double most = 0x1p53) {
    tell(WireEvent::looks, view, position[0], position[1], position[2], 700, 0.5, detail_px, most, 0);
  }
  /// A camera above the ground that looks along z.
  void look_at_picture(double x, double z, double detail_px) {
    tell(WireEvent::looks, view, x, 8, z, 700, 0.5, detail_px, 0x1p53, 800, 600, 700, 700, 399.5, 299.5, 0.25, 1, 0, 0,
         0, -1, 0, 0, 0, 1);
  }
  /// The frame before ends.
  void draw() {
    tell(WireEvent::frame, view);
    if (std::exchange(has_drawn_, true)) tell(WireEvent::frame_ends, view);
  }
  /// Idle readers ask, up to `n` at work.
  void ask(std::size_t n) {
    while (tasks.size() < n) {
      const std::size_t before = tasks.size();
      is_awake = false;
      tell(WireEvent::idle);
      if (tasks.size() == before && !is_awake) return;
    }
  }
  /// The oldest task ends.
  void finish(std::optional<Fault> fault = {}) {
    const Task task = tasks.front();
    tasks.erase(tasks.begin());
    if (task.n == 0) tell(WireEvent::probed, !fault);
    if (task.n == kTable && fault) tell(WireEvent::table_failed, static_cast<int>(*fault));
    if (task.n == kTable && !fault) grow(task.first);
    for (std::uint32_t i = 0; i < task.n && task.n != kTable; ++i) {
      if (!fault) {
        tell(WireEvent::arrived, task.first + i);
        continue;
      }
      const bool is_lost = *fault == Fault::lost;
      tell(WireEvent::failed, task.first + i, is_lost ? task.n - i : 1, static_cast<int>(*fault));
      if (is_lost) break;
    }
    tell(WireEvent::done);
  }
  /// Readers succeed until they have nothing to do.
  void settle() {
    for (ask(3); !tasks.empty(); ask(3)) finish();
  }
  const std::vector<lod::Page>& tree() const { return tree_.pages; }

  bool knows_all() const {
    return std::ranges::none_of(known_.pages, [](const lod::Page& page) { return page.count == 0; });
  }

  static constexpr std::uint32_t kTable = ~0U;
  struct Task {
    std::uint32_t first, n;  // of a read; n = 0: a probe; n = kTable: of the table, below group `first`
  };
  double now = 0;
  pages::ViewId view = 0;
  std::vector<Task> tasks;
  std::vector<std::uint32_t> drawn;
  std::uint32_t n_evicted = 0;
  double wakes = 0;
  bool is_awake = false, has_taken = false;
  const Wire& wire() const { return wire_; }

 private:
  static Tree beginning_of(Tree tree, std::size_t n_known) {
    for (std::size_t i = n_known; i < tree.pages.size(); ++i) tree.pages[i] = {}, tree.stored[i] = {};
    return tree;
  }
  static std::vector<double> numbers_of(const Tree& tree, std::size_t first, std::size_t end) {
    std::vector<double> numbers;
    for (std::size_t i = first; i < end; ++i) pages::put_page(tree.pages[i], tree.stored[i], numbers);
    return numbers;
  }
  /// A few more pages become known; a page that stays unknown is told with them.
  void grow(std::uint32_t group) {
    std::vector<lod::Page>& pages = known_.pages;
    std::size_t first = group == lod::kNoPage ? 0 : pages[group].first_child;
    while (pages[first].count > 0) ++first;
    const std::size_t end = std::min(first + 7, pages.size()), told = std::min(end + 1, pages.size());
    for (std::size_t i = first; i < end && pages[i].count == 0 && pages[tree_.pages[i].parent].count > 0; ++i)
      pages[i] = tree_.pages[i], known_.stored[i] = tree_.stored[i];
    std::vector<double> event{static_cast<double>(WireEvent::table_grew), static_cast<double>(group),
                              static_cast<double>(knows_all()), static_cast<double>(first),
                              static_cast<double>(told - first)};
    const std::vector<double> records = numbers_of(known_, first, told);
    event.insert(event.end(), records.begin(), records.end());
    tell_all(event);
  }
  void line(std::string_view name, std::span<const double> values) {
    text += name;
    for (const double value : values) put(text += ' ', value);
    text += '\n';
  }

  Tree tree_, known_;
  Wire wire_;
  bool has_drawn_ = false;
};

/// A tree whose boxes have few digits.
Tree tree(std::uint64_t seed, int n_levels) {
  Tree made(Seeded(seed), n_levels, 3, 96);
  for (lod::Page& page : made.pages) {
    for (Box* const box : {&page.bounds, &page.core}) {
      for (float* const side : {box->min.data(), box->max.data()}) {
        for (int k = 0; k < 3; ++k) side[k] = std::round(4 * side[k]) / 4;
      }
    }
    page.error = std::round(64 * page.error) / 64;
  }
  return made;
}

/// Budget beside the root, bytes a page and a Gaussian, readers, most bytes of a read and of a gap, prefetches.
std::vector<double> setup(double budget, double most_bytes = 1) {
  return {budget, 0, 1, 3, most_bytes, 0, 1};
}

/// The same bytes as the golden file NAME.txt; with RGS_WRITE_GOLDEN it is written.
void check_golden(const std::string& name, const Trace& trace) {
  CAPTURE(name);
  const std::string path = source_dir() + "/tests/golden/pages/" + name + ".txt";
  if (std::getenv("RGS_WRITE_GOLDEN") != nullptr) write_text(path, trace.text);
  CHECK(read_text(path) == trace.text);
}

}  // namespace

TEST_CASE("a trace of a camera inside a page's core, where the distance counts as z_near") {
  Trace trace(tree(3, 5), setup(1e6));
  const lod::Page& inside = trace.tree()[4];
  const std::vector<double> position{static_cast<double>(inside.core.min[0]) + 1, 2,
                                     static_cast<double>(inside.core.min[2]) + 1};
  for (const double detail : {0.0, 64.0, 1000.0, 4000.0}) {
    trace.look(position, detail);
    trace.draw();
    trace.settle();
    trace.now += 50 * kMillisecond;
    trace.draw();
    const lod::Eye eye{{position[0], position[1], position[2]}, 700, 0.5};
    CHECK(trace.drawn == lod::drawn_pages(trace.tree(), eye, static_cast<float>(detail)));
    CHECK(trace.wire().n_wanted(trace.view) == 0);
    CHECK(trace.wire().error_px(trace.view, 4) == static_cast<double>(inside.error) / (0.5 / 700));
  }
  check_golden("inside_core", trace);
}

TEST_CASE("a trace of budgets: pages leave, and frames are coarser") {
  Trace trace(tree(5, 6), setup(1000, 4000));
  Seeded random(1);
  for (int n = 0; n < 20; ++n) {
    const double most = n % 3 == 0 ? 0x1p53 : 100.0 * (1 + random.below(6));
    const double detail = 0.5 * random.below(8);
    trace.look({4.0 * random.below(24), 2, 4.0 * random.below(24)}, detail, most);
    trace.draw();
    for (int k = 0; k < 2; ++k) {
      for (trace.ask(3); trace.tasks.size() > 1;) trace.finish();
    }
    trace.now += kMillisecond * (1 + random.below(400));
    if (n == 8) trace.tell(WireEvent::take, 300);
    if (n == 14 && trace.has_taken) trace.tell(WireEvent::release, 300);
  }
  trace.settle();
  trace.draw();
  CHECK(trace.has_taken);
  CHECK(trace.n_evicted > 10);
  check_golden("budgets", trace);
}

TEST_CASE("a trace of reads that fail and bytes that are wrong") {
  Trace trace(tree(7, 5), setup(1e6));
  Seeded random(2);
  for (int n = 0; n < 60; ++n) {
    trace.look({30, 3, 40}, 0);
    trace.draw();
    trace.ask(3);
    const bool is_outage = n > 10 && n < 30;
    while (!trace.tasks.empty()) {
      const std::uint32_t group = trace.tasks.front().first;
      std::optional<Fault> fault;
      if (is_outage || random.happens(0.1)) {
        fault = Fault::lost;
      } else if (trace.tasks.front().n > 0 && group % 7 == 5) {
        fault = group % 2 == 0 ? Fault::damaged : Fault::checksum;
      }
      trace.finish(fault);
    }
    trace.now = std::max(trace.now + kMillisecond, trace.wakes);
  }
  CHECK(trace.wire().n_quarantined() > 1);
  CHECK(trace.wire().n_wanted(trace.view) == 0);
  check_golden("failures", trace);
}

TEST_CASE("a trace of a picture's camera that moves and turns") {
  Trace trace(tree(9, 5), setup(1e6, 4000));
  for (int n = 0; n < 20; ++n) {
    trace.look_at_picture(40 + 0.5 * n, 2 * n - 30, n < 10 ? 4 : 1);
    trace.draw();
    trace.ask(2);
    if (n % 2 == 1) trace.settle();
    trace.now += 40 * kMillisecond;
  }
  check_golden("picture", trace);
}

TEST_CASE("a trace of a table of pages that is read where views look, with failures") {
  Trace trace(tree(9, 5), setup(1e6), 4);
  Seeded random(3);
  const std::vector<double> position{80, 3, 70};
  for (int n = 0; n < 200 && !trace.knows_all(); ++n) {
    trace.look(position, 8);
    trace.draw();
    for (trace.ask(2); !trace.tasks.empty(); trace.ask(2)) {
      const bool is_table = trace.tasks.front().n == Trace::kTable;
      if (!is_table || !random.happens(0.3)) {
        trace.finish();
      } else {
        trace.finish(random.happens(0.5) ? Fault::lost : Fault::checksum);
      }
    }
    trace.now = std::max(trace.now + kMillisecond, trace.wakes);
  }
  CHECK(trace.knows_all());
  CHECK(trace.wire().n_quarantined() == 0);
  trace.draw();
  CHECK(trace.drawn == lod::drawn_pages(trace.tree(), lod::Eye{{80, 3, 70}, 700, 0.5}, 8));
  check_golden("table", trace);
}

TEST_CASE("a trace of a table that is damaged for good") {
  Trace trace(tree(9, 5), setup(1e6), 4);
  for (int n = 0; n < 20; ++n) {
    trace.look({80, 3, 70}, 0);
    trace.draw();
    for (trace.ask(2); !trace.tasks.empty(); trace.ask(2)) {
      trace.finish(trace.tasks.front().n == Trace::kTable ? std::optional(Fault::damaged) : std::nullopt);
    }
    trace.now = std::max(trace.now + kMillisecond, trace.wakes);
  }
  CHECK(trace.wire().n_quarantined() == 1);
  CHECK(trace.wire().n_wanted(trace.view) == 0);
  check_golden("broken_table", trace);
}
