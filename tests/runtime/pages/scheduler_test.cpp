// scheduler_test.cpp - one promise of a scheduler at a time.
// SPDX-License-Identifier: Apache-2.0
#include "pages/scheduler.hpp"

#include <doctest/doctest.h>

#include <algorithm>
#include <chrono>
#include <cstdint>
#include <optional>
#include <vector>

#include "pages_world.hpp"

using namespace rgs;
using namespace rgs::test;
using namespace std::chrono_literals;
using pages::Residency;
using pages::action::Verdict;
using pages::event::Fault;
using State = World::Reader::State;

namespace {

constexpr std::uint64_t kAmple = 1 << 30;

Tree tree(std::uint64_t seed = 1, int n_levels = 5) {
  return Tree(Seeded(seed), n_levels, 4);
}
/// Sees all of it, in leaves.
pages::Look over(float detail_px = 0) {
  return look_from(50, -150, 120, 0, detail_px);
}

std::uint32_t count(const World& world, const World::Scene* scene, Residency::State state) {
  const Residency& residency = world.scheduler.residency(scene->id);
  std::uint32_t n = 0;
  for (std::uint32_t page = 0; page < residency.n_pages(); ++page)
    n += scene->tree->pages[page].n_children > 0 && residency.state(page) == state;
  return n;
}

/// A world of one scene and one view.
struct Lone {
  World world;
  World::Scene* scene;
  World::View* view;

  explicit Lone(const World::Options& options = {}, std::uint64_t budget = kAmple)
      : world(budget), scene(world.open(tree(), options)), view(world.add_view(scene)) {}
  std::uint32_t n_groups() const { return scene->n_groups(); }
  /// All awake readers ask, and those with work fail or not, until none is awake.
  template <class FaultOf>
  void run(const FaultOf& fault_of) {
    for (int n = 0; world.is_awake(); ++n) {
      REQUIRE(n < 10'000);
      for (std::size_t i = 0; i < scene->readers.size(); ++i) {
        if (scene->readers[i].state == State::awake) world.ask(scene, i);
      }
      for (std::size_t i = 0; i < scene->readers.size(); ++i) {
        while (scene->readers[i].state == State::busy) world.finish(scene, i, fault_of(scene->readers[i]));
      }
      world.answer_grow();
    }
  }
  pages::Time next_wake() const {
    pages::Time next = pages::kNever;
    for (const World::Reader& r : scene->readers) next = std::min(next, r.wakes);
    return next;
  }
  void pass(pages::Time time) {
    world.now += time;
    world.wake_due();
  }
};

bool is_read(const World::Reader& r) {
  return World::next_group(r).has_value();
}

}  // namespace

TEST_CASE("a view comes to rest at the cut of the format, by reads of the largest error first") {
  Lone lone({.n_readers = 1, .most_bytes = 1});
  CHECK(lone.world.draw(lone.view, over()) == std::vector<std::uint32_t>{0});
  float before = 1e9F;
  std::uint64_t n_later = 0;
  lone.run([&](const World::Reader& r) -> std::optional<Fault> {
    const float error = lone.scene->known[*World::next_group(r)].error;
    n_later += error > before;
    before = error;
    return {};
  });
  CHECK(n_later < lone.n_groups() / 3);  // error over distance decides, and descendants are found in between
  CHECK(lone.world.draw(lone.view, over()) == World::expected(*lone.view));
  CHECK(lone.world.cut(lone.view).missing == 0);
  CHECK(lone.scene->n_reads == lone.n_groups());
  CHECK(lone.world.scheduler.is_at_rest(lone.scene->id));
  CHECK(lone.next_wake() == pages::kNever);
}

TEST_CASE("idle readers share what is wanted, and neighbours in the file are one read") {
  Lone lone({.n_readers = 6, .most_bytes = 1 << 20});
  lone.world.look(lone.view, over());
  lone.world.begin_frame(lone.view);
  for (std::size_t i = 0; i < 6; ++i) CHECK(lone.world.ask(lone.scene, i));
  lone.world.end_frame(0);
  lone.world.settle();
  CHECK(lone.scene->n_reads < lone.n_groups() / 2);
}

TEST_CASE("descendants are read beside their ancestor, and drawn only after it") {
  Lone lone({.n_readers = 4, .most_bytes = 1});
  lone.world.look(lone.view, over());
  lone.world.begin_frame(lone.view);
  lone.world.end_frame(0);
  REQUIRE(lone.world.ask(lone.scene, 0));
  REQUIRE(World::next_group(lone.scene->readers[0]) == 0);  // the root's children, which take long
  for (std::size_t i = 1; i < 4; ++i) {
    while (lone.world.ask(lone.scene, i)) lone.world.finish(lone.scene, i);
  }
  CHECK(count(lone.world, lone.scene, Residency::State::arrived) + 1 == lone.n_groups());
  CHECK(lone.world.draw(lone.view, over()) == std::vector<std::uint32_t>{0});
  CHECK(lone.world.cut(lone.view).in_flight == lone.n_groups());
  CHECK(lone.world.cut(lone.view).missing == lone.scene->known[0].n_children);
  lone.world.finish(lone.scene, 0);
  CHECK(lone.world.draw(lone.view, over()) == World::expected(*lone.view));
}

TEST_CASE("pages that wait for an ancestor that is lost or damaged make room, and come again after it") {
  for (const Fault fault : {Fault::lost, Fault::checksum}) {
    CAPTURE(fault == Fault::lost);
    Lone lone({.n_readers = 4, .most_bytes = 1});
    const std::uint64_t held = lone.world.scheduler.held();
    lone.world.draw(lone.view, over());
    REQUIRE(lone.world.ask(lone.scene, 0));
    for (std::size_t i = 1; i < 4; ++i) {
      while (lone.world.ask(lone.scene, i)) lone.world.finish(lone.scene, i);
    }
    REQUIRE(lone.world.scheduler.held() > 10 * held);
    lone.world.finish(lone.scene, 0, fault);
    CHECK(lone.world.scheduler.held() == held);
    CHECK(count(lone.world, lone.scene, Residency::State::absent) == lone.n_groups());
    lone.world.settle();
    CHECK(lone.world.draw(lone.view, over()) == World::expected(*lone.view));
  }
}

TEST_CASE("an outage that ends many reads is one failure: one probe, and each is read again after the first pause") {
  Lone lone({.n_readers = 6, .most_bytes = 1});
  lone.world.draw(lone.view, over());
  lone.world.wait(lone.view, lone.world.now + 1h);
  for (std::size_t i = 0; i < 6; ++i) REQUIRE(lone.world.ask(lone.scene, i));
  for (std::size_t i = 0; i < 6; ++i) lone.world.finish(lone.scene, i, Fault::lost);
  lone.world.settle();
  CHECK(lone.scene->n_probes == 1);
  CHECK(lone.view->verdict == Verdict::complete);
  CHECK(lone.world.now - 100s == 250ms);
}

TEST_CASE("a source that is gone is probed after pauses that grow up to a limit, and a caller is told at the third") {
  for (const bool waits : {false, true}) {
    CAPTURE(waits);
    Lone lone({.n_readers = 3, .most_bytes = 1});
    lone.world.draw(lone.view, over());
    if (waits) lone.world.wait(lone.view, lone.world.now + 1h);
    const auto all_lost = [](const World::Reader&) { return std::optional(Fault::lost); };
    lone.run(all_lost);
    pages::Time pause = 250ms;
    const std::uint64_t n_reads = lone.scene->n_reads;
    for (std::uint64_t n = 1; n < 10; ++n) {
      CHECK(lone.scene->n_probes == n);
      CHECK(lone.view->verdict.has_value() == (waits && n >= 3));
      CHECK(lone.next_wake() == lone.world.now + pause);
      lone.pass(pause);
      lone.run(all_lost);
      pause = std::min<pages::Time>(2 * pause, waits ? 1s : 8s);
    }
    CHECK(lone.scene->n_reads == n_reads);
    if (waits) {
      CHECK(lone.view->verdict == Verdict::lost);
      lone.world.end_wait(lone.view);
      // A new wait is a new chance.
      lone.world.wait(lone.view, lone.world.now + 1h);
      lone.world.settle();
      CHECK(lone.view->verdict == Verdict::complete);
    }
    lone.world.settle();
    CHECK(lone.world.draw(lone.view, over()) == World::expected(*lone.view));
  }
}

TEST_CASE("an unreadable range keeps nothing else from being read, and is read once it is there again") {
  Lone lone({.n_readers = 2});
  const std::uint32_t lost = lone.n_groups() - 1;
  lone.world.draw(lone.view, over());
  lone.world.wait(lone.view, lone.world.now + 1h);
  const auto fault_of = [&](const World::Reader& r) {
    return World::next_group(r) == lost ? std::optional(Fault::lost) : std::nullopt;
  };
  for (int n = 0; n < 3; ++n) {
    CHECK(!lone.view->verdict);
    lone.run(fault_of);
    if (n < 2) lone.pass(lone.next_wake() - lone.world.now);
  }
  CHECK(lone.view->verdict == Verdict::lost);
  CHECK(count(lone.world, lone.scene, Residency::State::resident) + 1 == lone.n_groups());
  lone.world.end_wait(lone.view);
  lone.world.settle();
  CHECK(lone.world.draw(lone.view, over()) == World::expected(*lone.view));
}

TEST_CASE("more unreadable groups than a list of wants holds leave time for everything else") {
  World world(kAmple);
  World::Scene* const scene = world.open(Tree(Seeded(7), 8, 5), {.n_readers = 2, .most_bytes = 1});
  World::View* const view = world.add_view(scene);
  world.draw(view, over());
  const auto is_lost = [&](std::uint32_t group) { return scene->known[group].level == 1 && group % 16 != 0; };
  std::uint32_t n_lost = 0, n_others = 0;
  const std::uint32_t n_groups = scene->n_groups();
  for (std::uint32_t group = 0; group < n_groups; ++group) ++(is_lost(group) ? n_lost : n_others);
  REQUIRE(n_lost > pages::kMostWants + 100);
  for (int n = 0; count(world, scene, Residency::State::resident) < n_others; ++n) {
    REQUIRE(n < 100'000);
    for (std::size_t i = 0; i < 2; ++i) {
      World::Reader& r = scene->readers[i];
      if (r.state == State::awake) world.ask(scene, i);
      if (r.state != State::busy) continue;
      const auto group = World::next_group(r);
      world.finish(scene, i, group && is_lost(*group) ? std::optional(Fault::lost) : std::nullopt);
    }
    world.now += 1ms;
    world.wake_due();
  }
}

TEST_CASE("a view whose pages cannot be read fails, whatever is read for another view meanwhile") {
  Lone lone({.n_readers = 2, .most_bytes = 1});
  // From its own side the view wants the first groups alone, and one of them is lost.
  const pages::Look coarse = over(12);
  World::View* const other = lone.world.add_view(lone.scene);
  lone.world.draw(lone.view, coarse);
  lone.world.settle();
  lone.world.draw(lone.view, coarse);
  REQUIRE(lone.world.cut(lone.view).missing == 0);
  lone.world.draw(lone.view, over(6));
  REQUIRE(lone.world.cut(lone.view).missing > 0);
  std::optional<std::uint32_t> lost;
  lone.world.wait(lone.view, lone.world.now + 1h);
  lone.world.draw(other, over());
  for (int n = 0; !lone.view->verdict; ++n) {
    REQUIRE(n < 1000);
    // Only one other group arrives between the failures.
    for (std::size_t i = 0; i < 2; ++i) {
      World::Reader& r = lone.scene->readers[i];
      if (r.state == State::awake) lone.world.ask(lone.scene, i);
      if (r.state != State::busy) continue;
      if (is_read(r) && !lost) lost = World::next_group(r);
      const bool is_lost = is_read(r) && World::next_group(r) == lost;
      lone.world.finish(lone.scene, i, is_lost ? std::optional(Fault::lost) : std::nullopt);
    }
    lone.pass(20ms);
  }
  CHECK(lone.view->verdict == Verdict::lost);
  lone.world.end_wait(lone.view);
  lone.world.settle();
  CHECK(lone.world.draw(lone.view, over(6)) == World::expected(*lone.view));
}

TEST_CASE("damaged bytes are read again after pauses that grow, a limited number of times; other damage is not") {
  for (const Fault fault : {Fault::checksum, Fault::damaged}) {
    for (const bool is_of_table : {false, true}) {
      CAPTURE(fault == Fault::checksum);
      CAPTURE(is_of_table);
      Lone lone({.n_readers = 1, .n_known = is_of_table ? 10U : ~0U, .most_bytes = 1});
      lone.world.draw(lone.view, over());
      const std::uint32_t bad = 2;
      const auto fault_of = [&](const World::Reader& r) -> std::optional<Fault> {
        const auto group = World::next_group(r);
        return (is_of_table ? !group : group == bad) ? std::optional(fault) : std::nullopt;
      };
      const int n_tries = is_of_table || fault == Fault::checksum ? pages::kMostTries : 1;
      lone.run(fault_of);
      pages::Time pause = 250ms;
      for (int n = 1; n < n_tries; ++n, pause *= 2) {
        CHECK(lone.world.scheduler.is_damaged(lone.scene->id));
        REQUIRE(lone.next_wake() == lone.world.now + pause);
        lone.pass(pause);
        lone.run(fault_of);
      }
      CHECK(lone.next_wake() == pages::kNever);
      lone.world.wait(lone.view, lone.world.now + 1h);
      lone.world.settle();  // what arrives now would be right
      CHECK(lone.view->verdict == Verdict::damaged);
      lone.world.end_wait(lone.view);
      CHECK(lone.world.scheduler.is_damaged(lone.scene->id));
      // The parent of what is damaged stays.
      const auto drawn = lone.world.draw(lone.view, over());
      if (!is_of_table) CHECK(std::ranges::count(drawn, bad) == 1);
      CHECK(lone.world.cut(lone.view).damaged > 0);
    }
  }
}

TEST_CASE("the table is read as far as views want it; the rest follows at rest, and only then is a view complete") {
  Lone lone({.n_readers = 2, .n_known = 5, .most_bytes = 1});
  lone.world.draw(lone.view, look_from(50, -60, 60, 0, 1e6F));  // the root is enough
  REQUIRE(lone.world.ask(lone.scene, 0));
  CHECK(!is_read(lone.scene->readers[0]));
  lone.world.wait(lone.view, lone.world.now + 1h);
  CHECK(!lone.view->verdict);
  lone.world.finish(lone.scene, 0);
  CHECK(!lone.view->verdict);
  lone.world.settle();
  CHECK(lone.view->verdict == Verdict::complete);
  CHECK(lone.scene->knows_all());
  CHECK(lone.scene->n_reads == 0);
}

TEST_CASE("pages of the table that no other page claims are read in the end, where they are refused") {
  Tree liar = tree();
  liar.pages.push_back(liar.pages.back());
  liar.stored.push_back(liar.stored.back());
  World world(kAmple);
  World::Scene* const scene =
      world.open(std::move(liar), {.n_readers = 1, .n_known = static_cast<std::uint32_t>(tree().pages.size())});
  World::View* const view = world.add_view(scene);
  world.draw(view, over(1e6F));
  for (int n = 0; n < pages::kMostTries; ++n) {
    REQUIRE(world.ask(scene, 0));
    const auto* more = std::get_if<pages::action::ReadTable>(&*scene->readers[0].task);
    REQUIRE(more != nullptr);
    CHECK(more->group == lod::kNoPage);
    world.finish(scene, 0, Fault::damaged);
    world.now += 10s;
  }
  CHECK(!world.ask(scene, 0));
}

TEST_CASE("the table is read where a view looks before the rest of it") {
  Lone lone({.n_readers = 1, .n_known = 1, .most_bytes = 1, .prefetches = false});
  World& world = lone.world;
  const pages::Look corner = look_from(5, 80, 3, 0, 1);
  const pages::ViewVolume volume(corner.view, corner.low_pass);
  world.draw(lone.view, corner);
  while (world.draw(lone.view, corner), world.cut(lone.view).missing > 0) {
    REQUIRE(world.ask(lone.scene, 0));
    if (const auto* more = std::get_if<pages::action::ReadTable>(&*lone.scene->readers[0].task))
      CHECK(volume.may_show(lone.scene->known[more->group].bounds));
    while (lone.scene->readers[0].state == State::busy) world.finish(lone.scene, 0, {}, 1);
  }
  CHECK(lone.scene->n_table_reads > 0);
  CHECK(lone.scene->n_known() < lone.scene->known.size() / 2);
  world.settle();
  CHECK(lone.scene->knows_all());
}

TEST_CASE("what no view wants leaves first, then what is wanted clearly less, of whichever scene") {
  World world(kAmple);
  World::Scene* const one = world.open(tree(1), {.most_bytes = 1});
  World::Scene* const two = world.open(tree(2), {.most_bytes = 1});
  World::View* const near = world.add_view(one);
  World::View* const far = world.add_view(two);
  const pages::Look beyond = look_from(50, -2000, 700, 0, 0);
  world.draw(far, beyond);
  world.settle();
  world.draw(far, beyond);
  REQUIRE(world.cut(far).missing == 0);
  REQUIRE(world.take(world.scheduler.left()));
  world.draw(near, over());
  world.draw(far, beyond);
  world.settle(false);
  CHECK(two->n_evicted > 0);
  CHECK(one->n_evicted == 0);
  CHECK(count(world, one, Residency::State::resident) > 0);
  // Not in turns: at rest each keeps what it has.
  const std::uint64_t n = one->n_reads + two->n_reads;
  for (int k = 0; k < 10; ++k) {
    world.draw(near, over());
    world.draw(far, beyond);
    world.settle(false);
  }
  CHECK(one->n_reads + two->n_reads == n);
}

TEST_CASE("a frame's pages stay until it ends, and what they were in the way of is read then") {
  World world(kAmple);
  World::Scene* const one = world.open(tree(1), {});
  World::Scene* const two = world.open(tree(2), {});
  World::View* const held = world.add_view(one);
  World::View* const other = world.add_view(two);
  world.draw(held, over());
  world.settle();
  world.look(held, over());
  world.begin_frame(held);
  REQUIRE(world.take(world.scheduler.left()));
  world.look(held, look_from(50, -20, 10, 3.14, 0));  // away
  world.draw(other, over());
  world.settle(false);
  CHECK(one->n_evicted == 0);
  CHECK(two->n_reads == 0);
  world.end_frame(0);
  world.settle(false);
  CHECK(one->n_evicted > 0);
  CHECK(two->n_reads > 0);
}

TEST_CASE("a wait ends at its deadline, and prefetch waits for it") {
  Lone lone({.n_readers = 1, .most_bytes = 1});
  lone.world.draw(lone.view, over());
  lone.world.wait(lone.view, lone.world.now + 1s);
  lone.world.now += 999ms;
  lone.world.tell(pages::event::Tick{});
  CHECK(!lone.view->verdict);
  lone.world.now += 1ms;
  lone.world.tell(pages::event::Tick{});
  CHECK(lone.view->verdict == Verdict::incomplete);
}

TEST_CASE("prefetch reads the pages that a moving camera is about to see") {
  const auto at = [](double x) { return look_from(x, -20, 8, 0, 4); };
  for (const bool prefetches : {true, false}) {
    CAPTURE(prefetches);
    Lone lone({.n_readers = 1, .most_bytes = 1, .prefetches = prefetches});
    lone.world.draw(lone.view, at(-20));
    lone.world.now += 250ms;
    lone.world.draw(lone.view, at(0));
    const auto& ahead = lone.world.scheduler.ahead(lone.view->id);
    REQUIRE(ahead.has_value() == prefetches);
    if (prefetches) CHECK(ahead->eye.position[0] == doctest::Approx(40));  // half a second ahead
    lone.world.settle();
    lone.world.draw(lone.view, at(0));
    CHECK(lone.world.cut(lone.view).missing == 0);
    lone.world.draw(lone.view, at(40));
    CHECK((lone.world.cut(lone.view).missing == 0) == prefetches);
  }
}

TEST_CASE("the predicted camera follows from the frames' times, turns on, and outlives the frame after a wait") {
  Lone lone;
  const auto soon = [&]() -> double {
    const auto& ahead = lone.world.scheduler.ahead(lone.view->id);
    return ahead ? ahead->eye.position[0] - lone.world.scheduler.eye(lone.view->id).eye.position[0] : -1;
  };
  const auto draw = [&](double x, double turn = 0) { lone.world.draw(lone.view, look_from(x, 0, 5, turn, 1)); };
  draw(0);
  CHECK(soon() == -1);
  lone.world.now += 250ms;
  draw(1);
  CHECK(soon() == doctest::Approx(2));
  lone.world.now += 250ms;
  lone.world.look(lone.view, look_from(1.5, 0, 5, 0, 1));
  lone.world.wait(lone.view, lone.world.now + 1h);
  lone.world.settle();
  lone.world.end_wait(lone.view);
  CHECK(soon() == doctest::Approx(1));
  draw(1.5);
  CHECK(soon() > 0);
  draw(1.5);
  CHECK(soon() == -1);  // it stands still
  // Never farther than the scene's size, and nothing is said of motion by frames far apart.
  lone.world.now += 250ms;
  draw(1e6);
  CHECK(soon() > 10);
  CHECK(soon() < 200);
  lone.world.now += 600ms;
  draw(2e6);
  CHECK(soon() == -1);
  // A turn of 0.1 in a quarter of a second becomes 0.2 ahead: the volume is nearest to that of a camera turned so (it is
  // predicted along a tangent).
  draw(50, 0.3);
  lone.world.now += 250ms;
  draw(50, 0.4);
  const auto& ahead = lone.world.scheduler.ahead(lone.view->id);
  REQUIRE(ahead);
  const auto n_same = [&](double turn) {
    const pages::Look look = look_from(50, 0, 5, turn, 1);
    const pages::ViewVolume volume(look.view, look.low_pass);
    return std::ranges::count_if(lone.scene->known, [&](const lod::Page& page) {
      return volume.may_show(page.bounds) == ahead->volume.may_show(page.bounds);
    });
  };
  CHECK(n_same(0.6) > n_same(0.4));
  CHECK(n_same(0.6) > n_same(0.8));
}

TEST_CASE("after a frame that does not fit, a view draws what fits, as the frames that fitted show") {
  Lone lone({.n_readers = 1});
  lone.world.draw(lone.view, over());
  lone.world.settle();
  const auto draw = [&](float detail_px, double fitting = 1) {
    lone.world.look(lone.view, over(detail_px));
    lone.world.begin_frame(lone.view);
    lone.world.end_frame(0, fitting);
    return lone.world.cut(lone.view).gaussians;
  };
  // A view with a limit gets finer by a step with each frame.
  const auto at_rest = [&](float detail_px) {
    for (int n = 0; n < 20; ++n) draw(detail_px);
    return draw(detail_px);
  };
  const std::uint64_t all = draw(2), some = draw(2.6F), few = draw(2.73F);
  REQUIRE(static_cast<double>(some) < 0.6 * static_cast<double>(all));
  draw(2, 0.6);
  const std::uint64_t fitted = draw(2);
  CHECK(fitted < few);
  // Others have fewer than was tried, but more than is known to fit.
  for (const float detail : {2.6F, 2.73F}) CHECK(at_rest(detail) <= fitted);
  // There is room for one of these, whatever else is drawn.
  draw(2, (static_cast<double>(few) + 1) / static_cast<double>(at_rest(2)));
  for (int n = 0; n < 2; ++n) {
    CHECK(at_rest(2.73F) == few);
    CHECK(at_rest(2.6F) < some);
    at_rest(20);
  }
  draw(2, 1e3);
  CHECK(at_rest(2) == all);
  CHECK(lone.scene->n_evicted == 0);
}

TEST_CASE("a view draws as many Gaussians as its look allows, the same whatever it drew before") {
  Lone lone({.n_readers = 3}), finest;
  pages::Look look = over();
  finest.world.draw(finest.view, look);
  finest.world.settle();
  const std::uint64_t all = (finest.world.draw(finest.view, look), finest.world.cut(finest.view).gaussians);
  const auto at_rest = [&](std::uint64_t most) {
    look.most_gaussians = most;
    std::uint64_t n_reads;
    do {
      n_reads = lone.scene->n_reads;
      lone.world.draw(lone.view, look);
      CHECK(lone.world.cut(lone.view).gaussians <= std::max<std::uint64_t>(most, lone.scene->known[0].count));
      lone.world.settle();
    } while (lone.scene->n_reads > n_reads);
    const std::vector<std::uint32_t> drawn = lone.world.draw(lone.view, look);
    const pages::Cut& cut = lone.world.cut(lone.view);
    CHECK(cut.wanted == 0);
    CHECK(cut.missing == 0);  // what is not allowed is not missing
    const auto choice = lod::finest_detail(lone.scene->known, look.eye, look.detail_px, most);
    CHECK(cut.detail_px == choice.detail_px);
    CHECK(cut.allowed_gaussians == choice.gaussians);
    return drawn;
  };
  const auto small = at_rest(all / 4);
  CHECK(lone.world.cut(lone.view).detail_px > look.detail_px);
  CHECK(lone.world.cut(lone.view).gaussians > all / 8);
  CHECK(lone.scene->n_reads < finest.scene->n_reads + lone.n_groups() / 2);
  CHECK(at_rest(1) == std::vector<std::uint32_t>{0});
  const auto large = at_rest(all);
  CHECK(large == World::expected(*lone.view));
  CHECK(at_rest(all / 4) == small);
}

TEST_CASE("a look without a picture sees everything") {
  Lone lone;
  const pages::Look with_picture = look_from(50, 50, 5, 0, 1);
  pages::Look look = with_picture;
  look.view = {};
  for (int n = 0; n < 3; ++n) {
    look.eye.position[0] += 1;
    lone.world.now += 100ms;
    lone.world.draw(lone.view, look);
    lone.world.settle();
  }
  CHECK(lone.world.scheduler.ahead(lone.view->id).has_value());
  lone.world.now += 100ms;
  const auto drawn = lone.world.draw(lone.view, look);
  CHECK_FALSE(lone.world.scheduler.ahead(lone.view->id).has_value());  // it stands still
  CHECK(drawn == lod::drawn_pages(lone.scene->known, look.eye, look.detail_px));
  CHECK(lone.world.draw(lone.view, with_picture).size() < drawn.size());
}

TEST_CASE("groups that a view wants are counted until they are resident or quarantined") {
  Lone lone({.n_readers = 1, .most_bytes = 1});
  const auto wanted = [&] {
    lone.world.draw(lone.view, over());
    return lone.world.cut(lone.view).wanted;
  };
  CHECK(wanted() == 1);
  REQUIRE(lone.world.ask(lone.scene, 0));
  CHECK(wanted() == 1 + lone.scene->known[0].n_children);
  lone.world.finish(lone.scene, 0);
  CHECK(wanted() == lone.scene->known[0].n_children);
  for (const Fault fault : {Fault::lost, Fault::checksum}) {  // they will be read again
    REQUIRE(lone.world.ask(lone.scene, 0));
    lone.world.finish(lone.scene, 0, fault);
    CHECK(wanted() == lone.scene->known[0].n_children);
    if (fault == Fault::lost) {
      REQUIRE(lone.world.ask(lone.scene, 0));
      lone.world.finish(lone.scene, 0);  // a probe
    }
  }
  const pages::Residency& residency = lone.world.scheduler.residency(lone.scene->id);
  CHECK(residency.n_quarantined() == 0);
  lone.pass(250ms);
  REQUIRE(lone.world.ask(lone.scene, 0));
  lone.world.finish(lone.scene, 0, Fault::damaged);
  CHECK(residency.n_quarantined() == 1);
  CHECK(wanted() == lone.scene->known[0].n_children - 1);
  lone.world.settle();
  CHECK(wanted() == 0);
  CHECK(residency.n_quarantined() == 1);
}
