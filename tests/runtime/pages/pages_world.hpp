// pages_world.hpp - a world for a scheduler: scenes without content, readers that tests let succeed or fail, cameras.
// It carries actions out like a driver and checks each of them against what it knows itself.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <doctest/doctest.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <memory>
#include <optional>
#include <span>
#include <utility>
#include <vector>

#include "counted_memory.hpp"
#include "pages/scheduler.hpp"

namespace rgs::test {

/// The same numbers everywhere (SplitMix64).
class Seeded {
 public:
  explicit Seeded(std::uint64_t seed) : state_(seed) {}
  std::uint64_t bits() {
    std::uint64_t z = state_ += 0x9E3779B97F4A7C15U;
    z = (z ^ (z >> 30)) * 0xBF58476D1CE4E5B9U;
    z = (z ^ (z >> 27)) * 0x94D049BB133111EBU;
    return z ^ (z >> 31);
  }
  std::uint32_t below(std::uint32_t n) { return static_cast<std::uint32_t>(bits() % n); }
  double uniform(double low, double high) { return low + (high - low) * static_cast<double>(bits() >> 11) * 0x1p-53; }
  bool happens(double share) { return uniform(0, 1) < share; }

 private:
  std::uint64_t state_;
};

/// A file's pages: a ground of `side` x `side`, split by halves.
struct Tree {
  std::vector<lod::Page> pages;
  std::vector<StoredPage> stored;

  Tree(Seeded random, int n_levels, std::uint32_t most_children, float side = 100) {
    lod::Page root;
    root.level = static_cast<std::uint32_t>(n_levels - 1);
    root.core = root.bounds = {{0, 0, 0}, {side, 4, side}};
    root.error = n_levels > 1 ? side / 20 : 0;
    pages.push_back(root);
    std::uint64_t first = 0, offset = 4096;
    for (std::uint32_t i = 0; i < pages.size(); ++i) {
      lod::Page& page = pages[i];
      page.first = first;
      page.count = 16 + random.below(48);
      first += page.count;
      stored.push_back({.offset = offset, .stored_bytes = page.count * 20});
      offset += page.count * 20 + (random.below(8) == 0 ? 5000 : 0);
      if (page.level == 0) continue;
      page.first_child = static_cast<std::uint32_t>(pages.size());
      page.n_children = 2 + random.below(most_children - 1);
      const lod::Page above = page;  // the vector grows
      const std::size_t axis = above.core.max[0] - above.core.min[0] > above.core.max[2] - above.core.min[2] ? 0 : 2;
      const float width = (above.core.max[axis] - above.core.min[axis]) / static_cast<float>(above.n_children);
      for (std::uint32_t k = 0; k < above.n_children; ++k) {
        lod::Page child;
        child.level = above.level - 1;
        child.parent = i;
        child.core = above.core;
        child.core.min[axis] = above.core.min[axis] + static_cast<float>(k) * width;
        child.core.max[axis] = child.core.min[axis] + width;
        child.bounds = child.core;
        child.error = child.level == 0 ? 0 : above.error * static_cast<float>(random.uniform(0.3, 0.8));
        pages.push_back(child);
      }
    }
  }
};

/// A camera above the ground that looks down along a direction.
inline pages::Look look_from(double x, double z, double height, double turn, float detail_px) {
  const double c = std::cos(turn), s = std::sin(turn);
  // Rows: right, down, forward, which falls by 30 degrees.
  const double down = 0.5, flat = std::sqrt(1 - down * down);
  const std::array<std::array<double, 3>, 3> r{
      {{c, 0, -s}, {-down * s, -flat, -down * c}, {flat * s, -down, flat * c}}};
  double matrix[16] = {};
  const double p[3] = {x, height, z};
  for (int i = 0; i < 3; ++i) {
    const auto row = static_cast<std::size_t>(i);
    for (int j = 0; j < 3; ++j) matrix[4 * i + j] = r[row][static_cast<std::size_t>(j)];
    matrix[4 * i + 3] = -(r[row][0] * p[0] + r[row][1] * p[1] + r[row][2] * p[2]);
  }
  matrix[15] = 1;
  const auto view = math::make_view<float>(matrix, 800, 600, 700.0, 700.0, 400.0, 300.0, 0.1F, 0.0F);
  return {{{x, height, z}, 700, 0.1}, view, 0.3F, detail_px};
}

class World {
 public:
  struct Reader {
    enum class State { asleep, awake, busy } state = State::awake;
    pages::Time wakes = pages::kNever;
    std::optional<pages::Action> task;
    std::uint32_t n_reported = 0;  // groups of a read
    pages::Time due{};
  };
  enum class Is : std::uint8_t { absent, read, placed };
  struct Scene {
    std::unique_ptr<Tree> tree;
    std::vector<lod::Page> known;  // what the scheduler sees: unknown ones have no Gaussians
    pages::SceneId id = 0;
    std::vector<Is> groups;
    std::vector<std::uint32_t> pins;  // [pages] frames that draw it
    std::vector<Reader> readers;
    std::uint64_t root_bytes = 0;
    std::uint64_t n_reads = 0, n_probes = 0, n_table_reads = 0, n_evicted = 0;

    std::uint32_t n_known() const {
      return static_cast<std::uint32_t>(std::ranges::count_if(known, [](const auto& page) { return page.count > 0; }));
    }
    bool knows_all() const { return n_known() == known.size(); }
    std::uint32_t n_groups() const {
      return static_cast<std::uint32_t>(
          std::ranges::count_if(tree->pages, [](const auto& page) { return page.n_children > 0; }));
    }
    std::uint32_t first_unknown(std::uint32_t group) const {
      std::uint32_t page = known[group].first_child;
      while (known[page].count > 0) ++page;
      return page;
    }
  };
  struct View {
    Scene* scene = nullptr;
    pages::ViewId id = 0;
    pages::Look look;
    std::vector<std::uint32_t> list;
    std::optional<std::uint32_t> drawn;
    bool needs_list = false;
    bool is_waiting = false;
    pages::Time deadline{};
    std::optional<pages::action::Verdict> verdict;
  };
  struct Frame {
    View* view;
    std::vector<std::uint32_t> pages;
    std::uint64_t gaussians;
    pages::Time due{};
  };

  explicit World(std::uint64_t budget) : scheduler(budget) {}

  struct Options {
    std::uint32_t n_readers = 2;
    std::uint32_t n_known = ~0U;  // pages at first
    std::uint64_t page_bytes = 32, row_bytes = 8, most_bytes = 4096, gap_bytes = 1000;
    bool prefetches = true;
  };
  /// Null if the root does not fit.
  Scene* open(Tree tree, const Options& options) {
    auto scene = std::make_unique<Scene>();
    scene->tree = std::make_unique<Tree>(std::move(tree));
    const auto n = static_cast<std::uint32_t>(scene->tree->pages.size());
    scene->root_bytes = options.page_bytes + options.row_bytes * scene->tree->pages[0].count;
    if (!take(scene->root_bytes)) return nullptr;
    scene->known.resize(n);
    const std::uint32_t n_known = std::min(n, std::max(1U, options.n_known));
    std::copy_n(scene->tree->pages.begin(), n_known, scene->known.begin());
    scene->groups.resize(n);
    scene->pins.resize(n);
    scene->readers.resize(options.n_readers);
    scene->id = scheduler.add_scene({.pages = &scene->known,
                                     .stored = scene->tree->stored.data(),
                                     .is_verified = n_known == n,
                                     .page_bytes = options.page_bytes,
                                     .row_bytes = options.row_bytes,
                                     .n_readers = options.n_readers,
                                     .most_bytes = options.most_bytes,
                                     .gap_bytes = options.gap_bytes,
                                     .prefetches = options.prefetches});
    return scenes.emplace_back(std::move(scene)).get();
  }
  /// Its readers and frames have ended.
  void close(Scene* scene) {
    std::erase_if(views, [&](const auto& view) { return view->scene == scene; });
    scheduler.remove_scene(scene->id);
    const std::uint64_t root = scene->root_bytes;
    std::erase_if(scenes, [&](const auto& one) { return one.get() == scene; });
    release(root);
    wake_all();
  }
  View* add_view(Scene* scene, std::size_t list = 8) {
    auto view = std::make_unique<View>();
    view->scene = scene;
    view->id = scheduler.add_view(scene->id);
    view->list.resize(list);
    return views.emplace_back(std::move(view)).get();
  }
  void remove_view(View* view) {
    scheduler.remove_view(view->id);
    std::erase_if(views, [&](const auto& one) { return one.get() == view; });
    release(0);  // a driver releases its memory
  }

  bool take(std::uint64_t bytes) {
    was_taken_.reset();
    tell(pages::event::Take{bytes});
    REQUIRE(was_taken_);
    if (*was_taken_) beside += bytes;
    return *was_taken_;
  }
  void release(std::uint64_t bytes) {
    beside -= bytes;
    tell(pages::event::Release{bytes});
  }
  void look(View* view, const pages::Look& look) {
    view->look = look;
    tell(pages::event::Looks{view->id, look});
  }
  /// A frame that is held until end(). `grows`: its list may.
  Frame& begin_frame(View* view, bool grows = true) {
    view->drawn.reset();
    for (bool can_grow = grows;;) {
      view->needs_list = false;
      tell(pages::event::Lists{view->id, view->list, can_grow});
      tell(pages::event::Frame{view->id});
      if (!view->needs_list) break;
      REQUIRE(can_grow);
      view->list.resize(2 * view->list.size());
    }
    REQUIRE(view->drawn);
    Frame frame{view, {view->list.begin(), view->list.begin() + *view->drawn}, cut(view).gaussians};
    check_drawn(*view, frame.pages);
    for (const std::uint32_t page : frame.pages) ++view->scene->pins[page];
    return frames.emplace_back(std::move(frame));
  }
  /// `fitting`: Gaussians for each that the frame has.
  void end_frame(std::size_t i, double fitting = 1) {
    const Frame frame = std::move(frames[i]);
    frames.erase(frames.begin() + static_cast<std::ptrdiff_t>(i));
    for (const std::uint32_t page : frame.pages) --frame.view->scene->pins[page];
    tell(pages::event::FrameEnds{frame.view->id, frame.pages, frame.gaussians,
                                 static_cast<std::uint64_t>(fitting * static_cast<double>(frame.gaussians))});
  }
  /// Draws one frame, and returns its pages.
  std::vector<std::uint32_t> draw(View* view, const pages::Look& camera, bool grows = true) {
    look(view, camera);
    std::vector<std::uint32_t> drawn = begin_frame(view, grows).pages;
    end_frame(frames.size() - 1);
    return drawn;
  }
  void wait(View* view, pages::Time deadline) {
    view->is_waiting = true;
    view->deadline = deadline;
    view->verdict.reset();
    tell(pages::event::Lists{view->id, view->list, true});
    tell(pages::event::Waits{view->id, deadline});
  }
  void end_wait(View* view) {
    view->is_waiting = false;
    tell(pages::event::WaitEnds{view->id});
  }
  const pages::Cut& cut(const View* view) const { return scheduler.last_cut(view->id); }

  /// An awake reader asks for work: true if it got some.
  bool ask(Scene* scene, std::size_t reader) {
    Reader& r = scene->readers[reader];
    REQUIRE(r.state != Reader::State::busy);
    r.state = Reader::State::asleep;
    r.wakes = pages::kNever;
    asking_ = &r;
    tell(pages::event::Idle{scene->id});
    asking_ = nullptr;
    return r.state == Reader::State::busy;
  }
  /// What a busy reader was to do is over, or its next group: `fault` if it failed.
  void finish(Scene* scene, std::size_t reader, std::optional<pages::event::Fault> fault = {},
              std::uint32_t rows = 16) {
    using namespace pages;
    Reader& r = scene->readers[reader];
    REQUIRE(r.state == Reader::State::busy);
    if (const auto* read = std::get_if<action::Read>(&*r.task)) {
      const std::uint32_t group = read->first + r.n_reported;
      if (!fault) {
        scene->groups[group] = Is::placed;
        ++r.n_reported;
        tell(event::Arrived{scene->id, group});
      } else {
        const std::uint32_t n = *fault == event::Fault::lost ? read->n - r.n_reported : 1;
        r.n_reported += n;
        tell(event::Failed{scene->id, group, n, *fault});
        for (std::uint32_t k = 0; k < n; ++k) CHECK(scene->groups[group + k] == Is::absent);
      }
      if (r.n_reported < read->n) return;
    } else if (const auto* more = std::get_if<action::ReadTable>(&*r.task)) {
      if (!fault) {
        std::vector<lod::Page>& known = scene->known;
        std::uint32_t page = scene->first_unknown(more->group);
        for (; rows > 0 && page < known.size() && known[page].count == 0; --rows, ++page) {
          const lod::Page& next = scene->tree->pages[page];
          if (known[next.parent].count == 0) break;
          known[page] = next;
        }
        tell(event::TableGrew{scene->id, more->group, scene->knows_all()});
      } else {
        tell(event::TableFailed{scene->id, *fault});
      }
    } else {
      tell(event::Probed{scene->id, !fault});
    }
    r.task.reset();
    r.state = Reader::State::awake;
    tell(event::Done{scene->id});
  }
  /// The next group of a busy reader's read; absent for a table or a probe.
  static std::optional<std::uint32_t> next_group(const Reader& r) {
    const auto* read = r.task ? std::get_if<pages::action::Read>(&*r.task) : nullptr;
    return read == nullptr ? std::nullopt : std::optional(read->first + r.n_reported);
  }
  void wake_all() {
    for (const auto& scene : scenes) {
      for (Reader& r : scene->readers) {
        if (r.state == Reader::State::asleep) r.state = Reader::State::awake;
      }
    }
  }
  /// Readers succeed until none has anything to do. `passes`: and time passes where all wait for it.
  void settle(bool passes = true) {
    const std::uint64_t before = n_steps;
    for (;;) {
      REQUIRE(n_steps - before < 1'000'000);
      bool is_any = false;
      for (std::size_t s = 0; s < scenes.size(); ++s) {
        for (std::size_t i = 0; i < scenes[s]->readers.size(); ++i) {
          Reader& r = scenes[s]->readers[i];
          if (r.state == Reader::State::awake) is_any = ask(scenes[s].get(), i) || is_any;
          if (r.state == Reader::State::busy) finish(scenes[s].get(), i), is_any = true;
        }
      }
      if (answer_grow() || is_any || is_awake()) continue;
      pages::Time next = pages::kNever;
      for (const auto& scene : scenes) {
        for (const Reader& r : scene->readers) next = std::min(next, r.wakes);
      }
      if (next == pages::kNever || !passes) return;
      now = std::max(now, next);
      wake_due();
    }
  }
  bool is_awake() const {
    for (const auto& scene : scenes) {
      for (const Reader& r : scene->readers) {
        if (r.state == Reader::State::awake) return true;
      }
    }
    return false;
  }
  void wake_due() {
    for (const auto& scene : scenes) {
      for (Reader& r : scene->readers) {
        if (r.state == Reader::State::asleep && r.wakes <= now) r.state = Reader::State::awake;
      }
    }
  }
  /// Waiting views whose list is too short get a longer one.
  bool answer_grow() {
    bool is_any = false;
    for (const auto& view : views) {
      if (!view->is_waiting || !std::exchange(view->needs_list, false)) continue;
      view->list.resize(2 * view->list.size());
      tell(pages::event::Lists{view->id, view->list, true});
      is_any = true;
    }
    return is_any;
  }

  void tell(const pages::Event& event) {
    using namespace pages;
    ++n_steps;
    const std::int64_t before = live_bytes();
    reset_peak_bytes();
    const std::span<const Action> actions = scheduler.step(event, now);
    if (counts_memory()) CHECK(peak_bytes() == before);  // nothing is allocated after setup
    for (const Action& action : actions) {
      if (const auto* read = std::get_if<action::Read>(&action)) {
        Scene& scene = scene_of(read->scene);
        for (std::uint32_t group = read->first; group < read->first + read->n; ++group) {
          const lod::Page& above = scene.known[group];
          REQUIRE(above.n_children > 0);
          for (std::uint32_t k = 0; k < above.n_children; ++k) CHECK(scene.known[above.first_child + k].count > 0);
          CHECK(scene.groups[group] == Is::absent);
          scene.groups[group] = Is::read;
        }
        ++scene.n_reads;
        begin(scene, action);
      } else if (const auto* more = std::get_if<action::ReadTable>(&action)) {
        Scene& scene = scene_of(more->scene);
        CHECK(!scene.knows_all());
        if (more->group != lod::kNoPage) {
          const lod::Page& above = scene.known[more->group];
          REQUIRE(above.n_children > 0);
          CHECK(scene.first_unknown(more->group) < above.first_child + above.n_children);
        }
        ++scene.n_table_reads;
        begin(scene, action);
      } else if (const auto* probe = std::get_if<action::Probe>(&action)) {
        ++scene_of(probe->scene).n_probes;
        begin(scene_of(probe->scene), action);
      } else if (const auto* evict = std::get_if<action::Evict>(&action)) {
        Scene& scene = scene_of(evict->scene);
        CHECK(scene.groups[evict->group] == (evict->was_placed ? Is::placed : Is::read));
        scene.groups[evict->group] = Is::absent;
        const lod::Page& above = scene.known[evict->group];
        for (std::uint32_t k = 0; k < above.n_children; ++k) CHECK(scene.pins[above.first_child + k] == 0);
        scene.n_evicted += evict->was_placed;
      } else if (const auto* draw = std::get_if<action::Draw>(&action)) {
        view_of(draw->view).drawn = draw->n;
      } else if (const auto* grow = std::get_if<action::Grow>(&action)) {
        view_of(grow->view).needs_list = true;
      } else if (const auto* refined = std::get_if<action::Refined>(&action)) {
        CHECK(view_of(refined->view).is_waiting);
        view_of(refined->view).verdict = refined->verdict;
      } else if (const auto* taken = std::get_if<action::Taken>(&action)) {
        was_taken_ = taken->is_taken;
      } else if (const auto* later = std::get_if<action::WakeAt>(&action)) {
        REQUIRE(asking_ != nullptr);
        CHECK(later->at > now);
        asking_->wakes = later->at;
      } else {
        for (const auto& scene : scenes) wake_one(*scene);
      }
    }
  }

  /// What must hold after each step.
  void check() const {
    std::uint64_t held = beside;
    for (const auto& scene : scenes) {
      for (std::uint32_t group = 0; group < scene->known.size(); ++group) {
        if (scene->groups[group] == Is::absent) continue;
        held += scheduler.group_bytes(scene->id, group);
        const auto state = scheduler.residency(scene->id).state(group);
        CHECK((scene->groups[group] == Is::read) == (state == pages::Residency::State::requested));
        // Every ancestor of what is resident is.
        if (state == pages::Residency::State::resident && group > 0) {
          const std::uint32_t above = scene->known[group].parent;
          CHECK(scheduler.residency(scene->id).state(above) == pages::Residency::State::resident);
        }
      }
    }
    CHECK(held == scheduler.held());
    CHECK(scheduler.held() <= scheduler.budget());
  }
  /// The picture at rest is the cut of docs/format/FORMAT.md.
  static std::vector<std::uint32_t> expected(const View& view) {
    const pages::ViewVolume volume(view.look.view, view.look.low_pass);
    const auto& all = view.scene->tree->pages;
    std::vector<std::uint32_t> cut = lod::drawn_pages(all, view.look.eye, view.look.detail_px);
    std::erase_if(cut, [&](std::uint32_t page) { return !volume.may_show(all[page].bounds); });
    return cut;
  }

  pages::Scheduler scheduler;
  pages::Time now = std::chrono::seconds(100);
  std::uint64_t beside = 0;  ///< taken by Take
  std::uint64_t n_steps = 0;
  std::vector<std::unique_ptr<Scene>> scenes;
  std::vector<std::unique_ptr<View>> views;
  std::vector<Frame> frames;

 private:
  Scene& scene_of(pages::SceneId id) {
    const auto found = std::ranges::find_if(scenes, [id](const auto& scene) { return scene->id == id; });
    REQUIRE(found != scenes.end());
    return **found;
  }
  View& view_of(pages::ViewId id) {
    const auto found = std::ranges::find_if(views, [id](const auto& view) { return view->id == id; });
    REQUIRE(found != views.end());
    return **found;
  }
  void begin(Scene& scene, const pages::Action& action) {
    REQUIRE(asking_ != nullptr);
    CHECK(!asking_->task);
    asking_->task = action;
    asking_->state = Reader::State::busy;
    asking_->n_reported = 0;
    wake_one(scene);  // may find more
  }
  static void wake_one(Scene& scene) {
    const auto idle = std::ranges::find(scene.readers, Reader::State::asleep, &Reader::state);
    if (idle != scene.readers.end()) idle->state = Reader::State::awake;
  }
  // Resident pages, of which none is above or below another, and which cover what the view sees.
  void check_drawn(const View& view, const std::vector<std::uint32_t>& drawn) const {
    const auto& pages = view.scene->known;
    const pages::ViewVolume volume(view.look.view, view.look.low_pass);
    std::vector<char> is_drawn(pages.size());
    for (const std::uint32_t page : drawn) {
      CHECK(scheduler.residency(view.scene->id).is_resident(page));
      CHECK((page == 0 || view.scene->groups[pages[page].parent] == Is::placed));
      CHECK(is_drawn[page] == 0);
      is_drawn[page] = 1;
    }
    for (std::uint32_t page = 0; page < pages.size(); ++page) {
      const bool has_children = pages[page].n_children > 0 && pages[pages[page].first_child].count > 0;
      if (pages[page].count == 0 || has_children) continue;
      if (!volume.may_show(pages[page].bounds)) continue;
      int n = 0;
      for (std::uint32_t above = page;; above = pages[above].parent) {
        n += is_drawn[above];
        if (above == 0) break;
      }
      CHECK(n == 1);
    }
  }

  Reader* asking_ = nullptr;
  std::optional<bool> was_taken_;
};

}  // namespace rgs::test
