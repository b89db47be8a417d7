// orbit_motion.hpp - how steady pictures are while the camera moves: a path around what it looks at, and what changes
// from frame to frame.
// SPDX-License-Identifier: Apache-2.0
//
// A Gaussian that changes its place in the order, or comes and goes as a whole, makes pixels jump although the camera
// moves smoothly: popping. Such a jump enters the step between two frames once, and the second difference, in which
// steady motion nearly cancels, twice. Two modes are compared by both, and by how the difference between their pictures
// changes from frame to frame: there the motion cancels altogether.
#pragma once

#include <cstddef>
#include <cstdint>
#include <functional>
#include <span>
#include <string>
#include <vector>

#include "rgs/camera.hpp"
#include "rgs/image.hpp"
#include "rgs/result.hpp"

namespace rgs::bench {

/// How far away what a camera looks at is: the median of its expected depths, of pixels that show something (> 0). 1 if
/// none does.
double look_at_distance(std::span<const float> depth);

/// `frames` cameras on an arc around the point `distance` ahead of `camera`, which is its middle: turned about the
/// vertical axis of the image, `degrees` from one to the next, the point staying where it is in all pictures.
std::vector<Camera> turntable(const Camera& camera, double distance, double degrees, int frames);

/// `frames` cameras that go straight back from `camera`, the first: from the point `distance` ahead of it `times` as far at
/// last, and by the same factor from each to the next.
std::vector<Camera> dolly(const Camera& camera, double distance, double times, int frames);

/// Absolute values of all channels of all pixels, over the frames of a sequence.
struct Change {
  double mean = 0;
  double p999 = 0;        ///< mean over the frames of the 99.9 percentile of each, exact to one part in 1024
  double worst_p999 = 0;  ///< of the frame where it is highest
  float largest = 0;      ///< of any pixel in any frame
};

/// Takes a sequence of pictures of one size; keeps the last two.
class MotionMeter {
 public:
  void add(std::span<const float> picture);
  Change step() const { return step_.change(); }      ///< I[t] - I[t-1]; 0 before the second picture
  Change second() const { return second_.change(); }  ///< I[t+1] - 2 I[t] + I[t-1]; 0 before the third

 private:
  class Statistic {
   public:
    template <class Value>
    void add_frame(std::size_t n, const Value& value);
    Change change() const;

   private:
    std::vector<std::uint32_t> bins_;  // of one frame
    double sum_ = 0, sum_p999_ = 0, worst_p999_ = 0;
    std::uint64_t n_ = 0, n_frames_ = 0;
    float largest_ = 0;
  };
  std::vector<float> last_, before_last_;
  Statistic step_, second_;
};

/// A mode on the path; for `added` see above.
struct OrbitRow {
  std::string mode;
  Change step, second;
  Change added;  ///< steps of its difference from the first mode; 0 for that one
};

/// Renders `path` in `modes` side by side; render(mode, camera) gives mode number `mode`'s picture [height, width, 3].
/// Errors: those of `render`.
Result<std::vector<OrbitRow>> follow(std::span<const Camera> path, std::span<const std::string> modes,
                                     const std::function<Result<Image>(std::size_t, const Camera&)>& render);

/// Steps of a sequence beside those of the truth, each over the truth's own between the same two frames, and the frame after
/// the largest: a single jump, where the sequence as a whole may hide it.
struct Jump {
  double mean = 0;  ///< of the mean steps
  double p999 = 0;  ///< of the 99.9 percentiles
  int mean_frame = 0, p999_frame = 0;
};
/// `steps` and `truth`: MotionMeter::step() of two pictures each, frame by frame.
Jump largest_jump(std::span<const Change> steps, std::span<const Change> truth);

/// The largest of a row's mean step, worst percentile of the steps, and worst percentile of the second differences, each over
/// the reference's. 1: no more popping than there. Motion hides what is rare and small; `added` shows it.
double unsteadiness(const OrbitRow& row, const OrbitRow& reference);

}  // namespace rgs::bench
