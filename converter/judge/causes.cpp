// causes.cpp - the table of causes, and which of them are in which program's sources.
// SPDX-License-Identifier: Apache-2.0
#include "causes.hpp"

#include <array>

namespace rgs::judge {
namespace {

constexpr float kSqrt8 = 2.8284271247461903F;

using R = Rules;

constexpr std::array kCauses = {
    // The projection.
    Cause{"low-pass-0.3", "adds a low-pass of 0.3 px^2, whatever the file declares", [](R& r) { r.low_pass = 0.3F; }},
    Cause{"low-pass-0.1", "adds a low-pass of 0.1 px^2", [](R& r) { r.low_pass = 0.1F; }},
    Cause{"low-pass-0.075", "adds a low-pass of 0.075 px^2, a quarter of the definition's",
          [](R& r) { r.low_pass = 0.075F; }},
    Cause{"low-pass-0.019", "adds a low-pass of 0.019 px^2, a sixteenth of the definition's",
          [](R& r) { r.low_pass = 0.3F / 16; }},
    Cause{"low-pass-none", "adds no low-pass", [](R& r) { r.low_pass = 0; }},
    Cause{"compensated", "lowers opacities for the low-pass, although the file does not ask for it",
          [](R& r) { r.compensated = true; }},
    Cause{"not-compensated", "does not lower opacities for the low-pass, although the file asks for it",
          [](R& r) { r.compensated = false; }},
    Cause{"slope-unclamped", "linearises the projection beyond the picture's edges without a limit",
          [](R& r) { r.clamps_slope = false; }},
    Cause{"clip-1.4", "drops Gaussians whose mean is more than 1.4 half pictures from the middle",
          [](R& r) { r.clip = 1.4F; }},
    Cause{"clip-1.3", "drops Gaussians whose mean is more than 1.3 half pictures from the middle",
          [](R& r) { r.clip = 1.3F; }},
    Cause{"clip-1.2", "drops Gaussians whose mean is more than 1.2 half pictures from the middle",
          [](R& r) { r.clip = 1.2F; }},
    Cause{"clip-1", "drops Gaussians whose mean is outside the picture", [](R& r) { r.clip = 1; }},
    Cause{"near-0", "draws Gaussians nearer than the near plane", [](R& r) { r.near_plane = 1e-3F; }},
    Cause{"near-0.1", "has its near plane at 0.1", [](R& r) { r.near_plane = 0.1F; }},
    Cause{"near-1", "has its near plane at 1", [](R& r) { r.near_plane = 1; }},
    Cause{"principal-point", "takes the middle of the picture for the principal point",
          [](R& r) { r.centres_picture = true; }},
    Cause{"fx-for-both", "takes the horizontal focal length for both", [](R& r) { r.focal = R::Focal::x; }},
    Cause{"fy-for-both", "takes the vertical focal length for both", [](R& r) { r.focal = R::Focal::y; }},
    Cause{"round-dropped", "does not draw Gaussians whose ellipse is a circle or lies along the rows",
          [](R& r) { r.drops_round = true; }},
    Cause{"rows-upright", "turns ellipses that lie along the rows upright", [](R& r) { r.axis_epsilon = 2.5e-5F; }},
    Cause{"round-stretched", "stretches circles into ellipses", [](R& r) { r.least_difference = 0.31622777F; }},
    Cause{"last-flattened", "forgets all but the x variance of the Gaussian farthest from the origin",
          [](R& r) { r.loses_last = true; }},
    Cause{"small-dropped", "drops Gaussians whose radius is below a pixel", [](R& r) { r.least_radius = 1; }},
    Cause{"radius-512", "shrinks Gaussians to a radius of 512 px", [](R& r) { r.most_radius = 512; }},
    Cause{"radius-1024", "shrinks Gaussians to a radius of 1024 px", [](R& r) { r.most_radius = 1024; }},
    // Of the picture's size: PlayCanvas.
    Cause{"radius-picture", "shrinks Gaussians to the picture's size", [](R& r) { r.most_radius = -1; }},
    // The colour.
    Cause{"sh-2", "draws harmonics to degree 2", [](R& r) { r.sh_degree = 2; }},
    Cause{"sh-1", "draws harmonics to degree 1", [](R& r) { r.sh_degree = 1; }},
    Cause{"sh-0", "draws no harmonics", [](R& r) { r.sh_degree = 0; }},
    Cause{"colour-clamped", "clamps each Gaussian's colour to 1 before it blends",
          [](R& r) { r.clamps_colour = true; }},
    Cause{"encoded-twice", "encodes the picture as sRGB, though it is",
          [](R& r) { r.transfer = R::Transfer::encoded; }},
    Cause{"decoded", "decodes the picture to linear light", [](R& r) { r.transfer = R::Transfer::decoded; }},
    Cause{"linear-blend", "blends linear light", [](R& r) { r.blend = R::Blend::linear; }},
    // The order.
    Cause{"by-distance", "sorts by distance instead of depth", [](R& r) { r.order = R::Order::distance; }},
    Cause{"unsorted", "draws in the file's order", [](R& r) { r.order = R::Order::file; }},
    Cause{"stale-order", "draws in the order of the camera before", [](R& r) { r.is_stale = true; }},
    Cause{"ties-reversed", "draws Gaussians of equal depth in the reverse of the file's order",
          [](R& r) { r.reverses_ties = true; }},
    Cause{"ties-morton", "draws Gaussians of equal depth in Morton order, not in the file's",
          [](R& r) { r.is_morton = true; }},
    Cause{"sort-16", "sorts by 16 bits", [](R& r) { r.sort_bits = 16; }},
    Cause{"sort-10", "sorts by 10 bits", [](R& r) { r.sort_bits = 10; }},
    // A pixel.
    Cause{"cut-sqrt8", "cuts Gaussians at sqrt(8) sigma", [](R& r) { r.cutoff = kSqrt8; }},
    Cause{"cut-3", "cuts Gaussians at 3 sigma", [](R& r) { r.cutoff = 3; }},
    Cause{"cut-2", "cuts Gaussians at 2 sigma", [](R& r) { r.cutoff = 2; }},
    Cause{"cut-square", "cuts Gaussians at a box of sqrt(8) sigma, not at an ellipse",
          [](R& r) { r.cutoff = kSqrt8, r.cuts_square = true; }},
    Cause{"cut-to-0", "cuts Gaussians at sqrt(8) sigma and bends them to 0 there",
          [](R& r) { r.cutoff = kSqrt8, r.falls_to_0 = true; }},
    Cause{"half-drawn", "draws one triangle of the two of each Gaussian in scenes of 3 to 5, and none of fewer",
          [](R& r) { r.draws_n_indices = true; }},
    Cause{"alpha-any", "draws alphas below 1/255", [](R& r) { r.alpha_min = 0; }},
    Cause{"alpha-0.5", "draws alphas from 0.5/255 on", [](R& r) { r.alpha_min = 0.5F / 255; }},
    Cause{"alpha-full", "lets alphas reach 1 instead of 0.99", [](R& r) { r.alpha_max = 1; }},
    Cause{"never-stops", "blends on below a transmittance of 0.0001", [](R& r) { r.transmittance_min = 0; }},
    Cause{"over-8-bit", "blends back to front in pixels of 8 bits",
          [](R& r) { r.blend = R::Blend::over, r.transmittance_min = 0; }},
    Cause{"over-8-bit-clamped", "blends colours clamped to 1, back to front in pixels of 8 bits",
          [](R& r) { r.blend = R::Blend::over_clamped, r.transmittance_min = 0; }},
    Cause{"under-8-bit", "blends front to back in pixels of 8 bits, alpha too",
          [](R& r) { r.blend = R::Blend::under, r.transmittance_min = 0; }},
    Cause{"background-white", "draws over white", [](R& r) { r.background = {1, 1, 1}; }},
    // Memory.
    Cause{"axes-ignored", "ignores the axes that the file declares", [](R& r) { r.ignores_axes = true; }},
    Cause{"fp32-world", "subtracts the camera from FP32 positions in the world",
          [](R& r) { r.positions = R::Positions::world; }},
    Cause{"fp16-world", "keeps positions in FP16", [](R& r) { r.positions = R::Positions::half; }},
    Cause{"fp16-camera", "keeps positions relative to the camera in FP16",
          [](R& r) { r.positions = R::Positions::camera; }},
    Cause{"fp16-covariance", "keeps covariances in FP16", [](R& r) { r.half_covariance = true; }},
    Cause{"fp16-scales", "keeps scales in FP16", [](R& r) { r.half_scales = true; }},
    Cause{"scale-steps-336", "keeps scales in steps of 6.4%", [](R& r) { r.scale_steps = 336; }},
    Cause{"scale-steps-255", "keeps scales in steps of 8.6%", [](R& r) { r.scale_steps = 255; }},
    Cause{"scale-steps-254", "keeps scales in steps of 8.6%", [](R& r) { r.scale_steps = 254; }},
    Cause{"8-bit-rotations", "keeps rotations in 8 bits a number", [](R& r) { r.rotation_bits = 8; }},
    Cause{"8-bit-opacity", "keeps opacities in 8 bits", [](R& r) { r.opacity_steps = 255; }},
    Cause{"7-bit-opacity", "keeps opacities in 7 bits", [](R& r) { r.even_opacity = true; }},
    Cause{"8-bit-colour", "keeps colours without harmonics in 8 bits, from 0 to 1", [](R& r) { r.colour_steps = 255; }},
    Cause{"8-bit-down", "rounds its 8 bits down", [](R& r) { r.rounds_down = true; }},
    Cause{"8-bit-seen-colour", "keeps colours with harmonics in 8 bits, from 0 to 1",
          [](R& r) { r.seen_colour_steps = 255, r.clamps_colour = true; }},
    Cause{"sh-to-1", "clamps harmonics to -1..1", [](R& r) { r.sh_limit = 1; }},
};

const std::vector<Client>& table() {
  static const std::vector<Client> clients = {
      {"roofgs", "RoofGS's page", {"fp32-world", "ties-morton", "over-8-bit", "fp16-scales"}},
      {"spark", "Spark", {"axes-ignored", "low-pass-0.3",    "compensated",   "slope-unclamped", "clip-1.4",
                          "near-0",       "principal-point", "radius-512",    "by-distance",     "ties-reversed",
                          "cut-sqrt8",    "alpha-0.5",       "alpha-full",    "over-8-bit",      "fp16-world",
                          "fp16-camera",  "scale-steps-254", "7-bit-opacity", "8-bit-colour",    "8-bit-seen-colour"}},
      {"playcanvas",
       "PlayCanvas",
       {"axes-ignored", "low-pass-0.075", "not-compensated", "slope-unclamped", "near-0", "principal-point",
        "round-dropped", "small-dropped", "radius-picture", "ties-morton", "cut-to-0", "alpha-full", "over-8-bit",
        "fp32-world", "8-bit-opacity", "scale-steps-255"}},
      {"gaussiansplats3d",
       "GaussianSplats3D",
       {"axes-ignored",       "low-pass-0.3",    "not-compensated", "slope-unclamped",
        "clip-1.2",           "principal-point", "round-stretched", "round-dropped",
        "last-flattened",     "half-drawn",      "radius-1024",     "sh-0",
        "ties-reversed",      "cut-sqrt8",       "alpha-any",       "alpha-full",
        "over-8-bit-clamped", "fp32-world",      "8-bit-opacity",   "8-bit-colour",
        "8-bit-down",         "sort-16"}},
      {"gsplatjs",
       "gsplat.js",
       {"axes-ignored", "low-pass-0.075", "not-compensated", "slope-unclamped", "clip-1.2", "principal-point",
        "round-dropped", "radius-1024", "sh-0", "cut-sqrt8", "alpha-any", "alpha-full", "under-8-bit", "fp32-world",
        "fp16-covariance", "8-bit-rotations", "8-bit-opacity", "8-bit-colour", "sort-16"}},
      {"cesium", "CesiumJS", {"low-pass-0.019",  "not-compensated", "slope-unclamped", "clip-1.2",
                              "principal-point", "round-dropped",   "small-dropped",   "radius-512",
                              "cut-square",      "ties-reversed",   "sh-to-1",         "scale-steps-336",
                              "8-bit-rotations", "alpha-any",       "alpha-full",      "over-8-bit",
                              "fp32-world",      "fp16-covariance", "8-bit-opacity",   "8-bit-colour"}},
      {"babylon",
       "Babylon.js",
       {"axes-ignored", "low-pass-0.075", "not-compensated", "slope-unclamped", "clip-1.2", "principal-point",
        "rows-upright", "radius-1024", "cut-sqrt8", "alpha-any", "alpha-full", "over-8-bit-clamped", "fp32-world",
        "fp16-covariance", "8-bit-rotations", "8-bit-opacity", "8-bit-colour", "sh-to-1", "sort-10"}},
  };
  return clients;
}

template <class List>
auto find(const List& list, std::string_view key) -> decltype(list.data()) {
  for (const auto& item : list)
    if (item.key == key) return &item;
  return nullptr;
}

}  // namespace

std::span<const Cause> all_causes() {
  return kCauses;
}
const Cause* find_cause(std::string_view key) {
  return find(kCauses, key);
}
std::span<const Client> clients() {
  return table();
}
const Client* find_client(std::string_view key) {
  return find(table(), key);
}

}  // namespace rgs::judge
