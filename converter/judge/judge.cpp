// judge.cpp - greedy adoption of causes.
// SPDX-License-Identifier: Apache-2.0
#include "judge.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <utility>

namespace rgs::judge {
namespace {

constexpr double kLeast = 1e-3;   // share below which a cause is not adopted
constexpr double kEnough = 0.05;  // unexplained share at which nothing more is tried

double psnr_of(double mse) {
  return mse > 0 ? -10 * std::log10(mse) : std::numeric_limits<double>::infinity();
}

bool has_8_bits(const Image& image) {
  return std::all_of(image.pixels.begin(), image.pixels.end(),
                     [](float v) { return std::abs(v * 255 - std::round(v * 255)) < 1e-3F; });
}

class Court {
 public:
  Court(const Scenes& scenes, std::span<const Shown> shown) : scenes_(scenes), shown_(shown) {
    for (const Shown& s : shown) {
      is_coded_.push_back(has_8_bits(s.picture));
      n_ += s.picture.pixels.size();
    }
  }

  std::vector<Image> drawn(const Rules& rules) const {
    std::vector<Image> images;
    for (std::size_t i = 0; i < shown_.size(); ++i) {
      images.push_back(draw(rules.ignores_axes ? scenes_.stored : scenes_.defined, shown_[i].camera, rules,
                            shown_[i == 0 ? 0 : i - 1].camera));
      for (float& v : images.back().pixels) v = compared(v, i);
    }
    return images;
  }
  // Of differences above `least`.
  double squares(const Image& image, std::size_t i, double least = 0) const {
    double sum = 0;
    for (std::size_t k = 0; k < image.pixels.size(); ++k) {
      const double d =
          static_cast<double>(compared(shown_[i].picture.pixels[k], i)) - static_cast<double>(image.pixels[k]);
      if (std::abs(d) > least) sum += d * d;
    }
    return sum;
  }
  double mse(const std::vector<Image>& images, double least = 0) const {
    double sum = 0;
    for (std::size_t i = 0; i < images.size(); ++i) sum += squares(images[i], i, least);
    return sum / static_cast<double>(n_);
  }
  double mean(const std::vector<Image>& images) const {
    double sum = 0;
    for (const Image& image : images)
      for (const float v : image.pixels) sum += static_cast<double>(v);
    return sum / static_cast<double>(n_);
  }

 private:
  // Both sides by this function: readers of 8 bits scale them by 1/255, whose rounding is no difference.
  float compared(float v, std::size_t i) const {
    // As to_8bit(), with NaN for 0: values near FP32's largest give it.
    return is_coded_[i] ? static_cast<float>(to_8bit(v)) / 255 : std::min(v > 0 ? v : 0.0F, 1.0F);
  }

  const Scenes& scenes_;
  std::span<const Shown> shown_;
  std::vector<bool> is_coded_;
  std::size_t n_ = 0;
};

// What has been adopted so far.
struct State {
  Rules rules;
  std::vector<Image> images;
  double mse = 0;
};

class Search {
 public:
  Search(const Court& court, const Rules& rules, Judgement& found) : court_(court), found_(found) {
    now_ = with(rules);
    found.mse = now_.mse;
  }
  State with(const Rules& rules) const {
    State state{rules, court_.drawn(rules), 0};
    state.mse = court_.mse(state.images);
    return state;
  }
  State with(const Cause& cause) const {
    Rules rules = now_.rules;
    cause.apply(rules);
    return with(rules);
  }
  const State& now() const { return now_; }
  double unexplained() const { return share(now_.mse); }
  /// Of it, what is in differences of more than one level.
  double rest() const { return share(court_.mse(now_.images, 1.01 / 255)); }

  // Greedy over `causes`, which loses what it adopts, until `enough` is explained. A cause is tried again only if what
  // it gained when it was last tried is the most of all, and once more when nothing else is left.
  void adopt(std::vector<const Cause*>& causes, bool is_known, double enough) {
    std::vector<double> gains;
    bool is_fresh = false;
    while (!causes.empty() && rest() > enough) {
      if (gains.empty()) {
        for (const Cause* cause : causes) gains.push_back(now_.mse - with(*cause).mse);
        is_fresh = true;
      }
      const auto best = std::max_element(gains.begin(), gains.end());
      if (*best < kLeast * found_.mse) {
        if (is_fresh) return;
        gains.clear();
        continue;
      }
      const auto which = causes.begin() + (best - gains.begin());
      State next = with(**which);
      *best = now_.mse - next.mse;
      if (*best < *std::max_element(gains.begin(), gains.end())) continue;
      take(**which, is_known, std::move(next));
      causes.erase(which);
      gains.erase(best);
      is_fresh = false;
    }
  }
  // Where each alone explains nothing: all of them, if they do.
  void adopt_all(std::vector<const Cause*>& causes) {
    if (causes.empty() || unexplained() <= 0) return;
    Rules rules = now_.rules;
    for (const Cause* cause : causes) cause->apply(rules);
    if (now_.mse - with(rules).mse < kEnough * found_.mse) return;
    // Each time the one that leaves the least, although it may leave more than there was.
    while (!causes.empty()) {
      State best;
      auto which = causes.end();
      for (auto it = causes.begin(); it != causes.end(); ++it)
        if (State next = with(**it); which == causes.end() || next.mse < best.mse) best = std::move(next), which = it;
      // One that changes nothing yet may do so with a later one.
      if (best.mse != now_.mse)
        take(**which, true, std::move(best));
      else
        now_ = std::move(best);
      causes.erase(which);
    }
  }

 private:
  double share(double mse) const { return found_.mse > 0 ? mse / found_.mse : 0; }
  void take(const Cause& cause, bool is_known, State next) {
    found_.steps.push_back({&cause, is_known, (now_.mse - next.mse) / found_.mse, psnr_of(next.mse),
                            255 * (court_.mean(next.images) - court_.mean(now_.images))});
    now_ = std::move(next);
  }

  const Court& court_;
  Judgement& found_;
  State now_;
};

}  // namespace

double Judgement::psnr() const {
  return psnr_of(mse);
}

Rules definition(const std::optional<Declarations>& declared, float near_plane) {
  const RenderOptions options = with_declarations({}, declared);
  Rules rules;
  rules.near_plane = near_plane;
  rules.compensated = options.anti_aliasing == math::AntiAliasing::mip_splatting;
  rules.low_pass = options.low_pass.value_or(math::kLowPass);
  return rules;
}

Judgement judge(const Scenes& scenes, std::span<const Shown> shown, const Rules& rules, const Client* client) {
  Judgement found;
  const Court court(scenes, shown);
  Search search(court, rules, found);
  const std::vector<Image> defined = search.now().images;
  std::vector<const Cause*> known, others;
  if (client != nullptr)
    for (const std::string_view key : client->causes) known.push_back(find_cause(key));
  search.adopt(known, true, 0);
  search.adopt_all(known);
  for (const Cause& cause : all_causes())
    if (std::none_of(found.steps.begin(), found.steps.end(), [&](const Step& s) { return s.cause == &cause; }))
      others.push_back(&cause);
  search.adopt(others, false, kEnough);
  found.rest = search.rest();
  found.rounding = search.unexplained() - found.rest;
  for (std::size_t i = 0; i < shown.size(); ++i) {
    const auto n = static_cast<double>(shown[i].picture.pixels.size());
    found.views.push_back({shown[i].camera.name, defined[i], search.now().images[i],
                           psnr_of(court.squares(defined[i], i) / n),
                           psnr_of(court.squares(search.now().images[i], i) / n)});
  }
  return found;
}

}  // namespace rgs::judge
