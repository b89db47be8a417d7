// wire.cpp - events from numbers, and actions to numbers.
// SPDX-License-Identifier: Apache-2.0
#include "pages/wire.hpp"

#include <algorithm>
#include <initializer_list>
#include <iterator>
#include <utility>
#include <variant>

#include "rgs/math/constants.hpp"

namespace rgs::pages {
namespace {

/// Takes one number after the other.
class Numbers {
 public:
  explicit Numbers(std::span<const double> values) : left_(values) {}
  bool is_empty() const { return left_.empty(); }
  template <class T>
  T next() {
    const double value = left_.front();
    left_ = left_.subspan(1);
    return static_cast<T>(value);
  }
  std::uint64_t bytes() { return next<std::uint64_t>(); }
  std::uint32_t index() { return next<std::uint32_t>(); }
  double number() { return next<double>(); }

 private:
  std::span<const double> left_;
};

Box box_of(Numbers& in) {
  Box box;
  for (float& x : box.min) x = in.next<float>();
  for (float& x : box.max) x = in.next<float>();
  return box;
}

void take_page(Numbers& in, lod::Page& page, StoredPage& stored) {
  page.level = in.index();
  const double parent = in.number();
  page.parent = parent < 0 ? lod::kNoPage : static_cast<std::uint32_t>(parent);
  page.first_child = in.index();
  page.n_children = in.index();
  page.first = in.bytes();
  page.count = in.index();
  page.error = in.next<float>();
  page.bounds = box_of(in);
  page.core = box_of(in);
  stored.offset = in.bytes();
  stored.stored_bytes = in.index();
  stored.n_step_sets = in.index();
  stored.scale_exponent = in.next<std::int16_t>();
}

void put_box(const Box& box, std::vector<double>& numbers) {
  for (const float x : box.min) numbers.push_back(static_cast<double>(x));
  for (const float x : box.max) numbers.push_back(static_cast<double>(x));
}

Look look_of(Numbers& in) {
  Look look;
  for (double& x : look.eye.position) x = in.number();
  look.eye.focal_px = in.number();
  look.eye.z_near = in.number();
  look.detail_px = in.next<float>();
  if (const double most = in.number(); most < 0x1p53) look.most_gaussians = static_cast<std::uint64_t>(most);
  const int width = in.next<int>();
  if (width == 0) return look;
  const int height = in.next<int>();
  const double fx = in.number(), fy = in.number(), cx = in.number(), cy = in.number();
  look.low_pass = in.next<float>();
  double matrix[16] = {};
  for (int i = 0; i < 3; ++i) {
    double* const row = matrix + 4 * i;
    for (int j = 0; j < 3; ++j) row[j] = in.number();
    const auto& p = look.eye.position;
    row[3] = -(row[0] * p[0] + row[1] * p[1] + row[2] * p[2]);
  }
  matrix[15] = 1;
  look.view = math::make_view<float>(matrix, width, height, fx, fy, cx, cy, math::kNearPlane, 0.0F);
  return look;
}

}  // namespace

void put_page(const lod::Page& page, const StoredPage& stored, std::vector<double>& numbers) {
  const double parent = page.parent == lod::kNoPage ? -1 : static_cast<double>(page.parent);
  const double of_page[] = {static_cast<double>(page.level),       parent,
                            static_cast<double>(page.first_child), static_cast<double>(page.n_children),
                            static_cast<double>(page.first),       static_cast<double>(page.count),
                            static_cast<double>(page.error)};
  numbers.insert(numbers.end(), std::begin(of_page), std::end(of_page));
  put_box(page.bounds, numbers);
  put_box(page.core, numbers);
  const double of_bytes[] = {static_cast<double>(stored.offset), static_cast<double>(stored.stored_bytes),
                             static_cast<double>(stored.n_step_sets), static_cast<double>(stored.scale_exponent)};
  numbers.insert(numbers.end(), std::begin(of_bytes), std::end(of_bytes));
}

Wire::Wire(std::span<const double> setup, std::span<const double> pages)
    : scheduler_(static_cast<std::uint64_t>(setup.front())) {
  const std::size_t n = pages.size() / kPageNumbers;
  pages_.resize(n);
  stored_.resize(n);
  Numbers in(pages);
  for (std::size_t i = 0; i < n; ++i) take_page(in, pages_[i], stored_[i]);
  Numbers of(setup.subspan(1));
  SceneSetup scene{.pages = &pages_, .stored = stored_.data(), .is_verified = knows_all()};
  scene.page_bytes = of.bytes();
  scene.row_bytes = of.bytes();
  scene.n_readers = of.index();
  scene.most_bytes = of.bytes();
  scene.gap_bytes = of.bytes();
  scene.prefetches = of.number() != 0;
  scene_ = scheduler_.add_scene(scene);
}

bool Wire::knows_all() const {
  return std::none_of(pages_.begin() + 1, pages_.end(),
                      [](const lod::Page& page) { return page.parent == lod::kNoPage; });
}

ViewId Wire::add_view() {
  views_.emplace_back().list.resize(64);
  return scheduler_.add_view(scene_);
}

std::span<const double> Wire::step(std::span<const double> events, double now) {
  now_ = Time(static_cast<Time::rep>(now));
  actions_.clear();
  for (Numbers in(events); !in.is_empty();) {
    switch (in.next<WireEvent>()) {
      case WireEvent::looks: {
        const ViewId view = in.index();
        tell(event::Looks{view, look_of(in)});
        break;
      }
      case WireEvent::frame: begin_frame(in.index()); break;
      case WireEvent::frame_ends: {
        const ViewId view = in.index();
        const Frame frame = std::move(views_[view].frames.front());
        views_[view].frames.erase(views_[view].frames.begin());
        tell(event::FrameEnds{view, frame.pages, frame.gaussians, frame.gaussians});
        break;
      }
      case WireEvent::idle: tell(event::Idle{scene_}); break;
      case WireEvent::done: tell(event::Done{scene_}); break;
      case WireEvent::arrived: tell(event::Arrived{scene_, in.index()}); break;
      case WireEvent::failed: {
        const std::uint32_t first = in.index(), n = in.index();
        tell(event::Failed{scene_, first, n, in.next<event::Fault>()});
        break;
      }
      case WireEvent::probed: tell(event::Probed{scene_, in.number() != 0}); break;
      case WireEvent::take: tell(event::Take{in.bytes()}); break;
      case WireEvent::release: tell(event::Release{in.bytes()}); break;
      case WireEvent::table_grew: {
        const std::uint32_t group = in.index();
        const bool is_verified = in.number() != 0;
        const std::uint32_t first = in.index(), n = in.index();
        for (std::uint32_t i = first; i < first + n; ++i) {
          lod::Page page;
          StoredPage stored;
          take_page(in, page, stored);
          if (i == 0 || page.parent != lod::kNoPage) pages_[i] = page, stored_[i] = stored;
        }
        // Whoever told of a group as any, or not of all, is asked on.
        const std::uint32_t grown = group == lod::kNoPage && n > 0 ? pages_[first].parent : group;
        tell(event::TableGrew{scene_, grown, is_verified && knows_all()});
        break;
      }
      case WireEvent::table_failed: tell(event::TableFailed{scene_, in.next<event::Fault>()}); break;
    }
  }
  return actions_;
}

void Wire::begin_frame(ViewId id) {
  View& view = views_[id];
  for (;;) {
    must_grow_ = false;
    tell(event::Lists{id, view.list, true});
    tell(event::Frame{id});
    if (!must_grow_) return;
    view.list.resize(2 * view.list.size());
  }
}

void Wire::tell(const Event& event) {
  const auto put = [this](WireAction code, std::initializer_list<double> fields = {}) {
    actions_.push_back(static_cast<double>(code));
    actions_.insert(actions_.end(), fields.begin(), fields.end());
  };
  const auto number = [](auto value) { return static_cast<double>(value); };
  for (const Action& action : scheduler_.step(event, now_)) {
    if (const auto* read = std::get_if<action::Read>(&action)) {
      put(WireAction::read, {number(read->first), number(read->n)});
    } else if (std::holds_alternative<action::Probe>(action)) {
      put(WireAction::probe);
    } else if (const auto* table = std::get_if<action::ReadTable>(&action)) {
      put(WireAction::read_table, {number(table->group)});
    } else if (const auto* evict = std::get_if<action::Evict>(&action)) {
      put(WireAction::evict, {number(evict->group)});
    } else if (const auto* draw = std::get_if<action::Draw>(&action)) {
      const auto list = std::span(views_[draw->view].list).first(draw->n);
      put(WireAction::draw, {number(draw->view), number(draw->n)});
      actions_.insert(actions_.end(), list.begin(), list.end());
      views_[draw->view].frames.push_back({{list.begin(), list.end()}, scheduler_.last_cut(draw->view).gaussians});
    } else if (std::holds_alternative<action::Grow>(action)) {
      must_grow_ = true;
    } else if (const auto* taken = std::get_if<action::Taken>(&action)) {
      put(WireAction::taken, {number(taken->is_taken)});
    } else if (const auto* later = std::get_if<action::WakeAt>(&action)) {
      put(WireAction::wake_at, {number(later->at.count())});
    } else if (std::holds_alternative<action::Wake>(action)) {
      put(WireAction::wake);
    }
  }
}

double Wire::error_px(ViewId view, std::uint32_t page) const {
  const lod::Page& one = pages_[page];
  return static_cast<double>(pages::error_px(one, lod::footprint(one.core, scheduler_.eye(view).eye)));
}

}  // namespace rgs::pages
