// diff.hpp - what differs between two splat files: values only; diff_report.cpp prints them.
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <cstdint>
#include <string>
#include <vector>

#include "audit.hpp"
#include "audit_pairing.hpp"
#include "audit_source.hpp"

namespace rgs::audit {

/// How an attribute of matched Gaussians changed. A value that is not a number on one side alone is an infinite change.
struct Change {
  const char* key = "";
  const char* unit = "";
  std::uint64_t n = 0;          ///< Gaussians in which it differs
  double largest = 0, rms = 0;  ///< in `unit`; RMS over all matched Gaussians
  std::uint64_t a = 0, b = 0;   ///< of the largest: index in each file, if n is not 0
};

/// What happened to a Gaussian of B, the first that holds.
enum class Fate : std::uint8_t { unchanged, moved, reshaped, recoloured, opacity, added };

/// Pictures of both by a camera.
struct DiffView {
  std::string name;
  double psnr = 0;    ///< infinity for equal pictures
  float largest = 0;  ///< difference of a channel
};

struct Diff {
  struct Side {
    std::string path, format;
    std::uint64_t bytes = 0, n = 0;
    int sh_degree = 0;
  };
  Side a, b;
  PairReport pairs;
  double tolerance = 0;  ///< world units; means that differ by no more are equal
  std::uint64_t n_equal = 0, n_reshaped = 0;
  /// Mean, scale, rotation, colour, opacity.
  std::array<Change, 5> changes{{{"mean", "world units"},
                                 {"scale", "% of the scale"},
                                 {"rotation", "degrees"},
                                 {"colour", "8-bit levels"},
                                 {"opacity", "% points"}}};
  std::vector<DeclaredDifference> declared;
  std::vector<Fate> fates;             ///< [n of B]
  std::vector<std::uint32_t> removed;  ///< rows of A alone
  std::vector<DiffView> views{};       ///< if pictures are asked for

  bool same() const;
};

/// The two files, Gaussians of B in the axes of A.
struct Sides {
  Source a, b;
};

/// Compares the files' Gaussians. Values are compared as read: exactly, a rotation up to sign, length (as FP32 rounds it)
/// and names of the Gaussian's axes, which do not change its covariance. Results do not depend on the number of threads.
/// Errors: those of Source::open() and pair_gaussians().
Outcome<Diff> compare_files(const std::string& a, const std::string& b, const ReadOptions& options, double tolerance,
                            Sides& sides);

/// Writes B's Gaussians and A's removed ones after them as a PLY of SH degree 0 in the colours of their fates.
Status write_fates(const std::string& path, const Diff& diff, const Sides& sides, bool overwrite);

/// The files of draw_differences(): NAME.a.png, NAME.b.png and NAME.difference.png in `folder`, by the cameras of
/// `options`. Errors: those of choose_views().
Outcome<std::vector<std::string>> difference_paths(const std::string& folder, const Options& options);
/// Draws both, each with the anti-aliasing that it declares, by the cameras of `options`, into difference_paths().
/// Errors: those of choose_views(), rendering and writing.
Outcome<std::vector<DiffView>> draw_differences(const std::string& folder, const Sides& sides, const Options& options,
                                                bool overwrite);

/// Schema "rgs-diff/1", docs/user/DIFF_JSON.md; ASCII, "\n" at the end.
std::string diff_json(const Diff& diff);
std::string diff_text(const Diff& diff);

}  // namespace rgs::audit
