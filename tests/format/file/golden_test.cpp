// golden_test.cpp - files committed for formats 1.0 to 1.5: exact bytes from the encoder, expected values from the
// decoder, and files with one defect.
// SPDX-License-Identifier: Apache-2.0
#include <doctest/doctest.h>
#include <zstd.h>

#include <algorithm>
#include <cmath>
#include <map>
#include <set>
#include <sstream>
#include <string_view>

#include "archive_bounds.hpp"
#include "archive_pages.hpp"
#include "edit_file.hpp"
#include "golden_files.hpp"
#include "golden_levels.hpp"
#include "golden_scenes.hpp"
#include "instruction_sets.hpp"
#include "reject_cases.hpp"
#include "rgs/decode.hpp"
#include "rgs/paged_file.hpp"
#include "rgs/quantize.hpp"
#include "skip.hpp"

using namespace rgs;
using namespace rgs::test;
namespace fs = std::filesystem;

namespace {

const fs::path kGolden = golden_folder();

// Compressed bytes depend on the library: the coded files were written with this version.
bool same_library(Profile profile) {
  return profile == Profile::direct || ZSTD_versionNumber() == 10504;
}

Bytes golden(const std::string& name) {
  return golden_file(name);
}

void check_bytes(Profile profile) {
  for (const GoldenScene& scene : golden_scenes()) {
    if (scene.options.profile != profile || scene.earlier) continue;
    CAPTURE(scene.name);
    const auto bytes = encode(scene.cloud.view(), scene.options);
    REQUIRE(bytes);
    const Bytes expected = golden(scene.name);
    REQUIRE(bytes->size() == expected.size());
    const auto difference = std::ranges::mismatch(*bytes, expected);
    CHECK(difference.in1 - bytes->begin() == static_cast<std::ptrdiff_t>(expected.size()));
  }
}

}  // namespace

TEST_CASE("the encoder writes the bytes of every direct golden file") {
  check_bytes(Profile::direct);
}

TEST_CASE("the encoder writes the bytes of every packed golden file") {
  if (!same_library(Profile::packed)) return skip_without_tool("another version of Zstandard writes other bytes");
  check_bytes(Profile::packed);
}

TEST_CASE("the encoder writes the bytes of every archived golden file") {
  if (!same_library(Profile::archive)) return skip_without_tool("another version of Zstandard writes other bytes");
  check_bytes(Profile::archive);
}

TEST_CASE("the writer writes the bytes of every golden file with levels") {
  for (const GoldenLevels& scene : all_golden_levels()) {
    if (!same_library(scene.options.profile) || scene.earlier) continue;
    CAPTURE(scene.name);
    const Bytes bytes = encode_levels(scene), expected = golden(scene.name);
    REQUIRE(bytes.size() == expected.size());
    CHECK(bytes == expected);
  }
}

TEST_CASE("every golden file has the scene that it was written from") {
  std::set<std::string> names{"archive_base.rgs", "levels_archive_base.rgs"};  // files of reject/ are made from these
  for (const GoldenLevels& scene : all_golden_levels()) names.insert(scene.name + ".rgs");
  for (const GoldenScene& scene : golden_scenes()) names.insert(scene.name + ".rgs");
  for (const auto& entry : fs::directory_iterator(kGolden)) {
    if (entry.path().extension() == ".rgs") CHECK(names.count(entry.path().filename()) == 1);
  }
}

TEST_CASE("the golden file of two Gaussians holds the values known by hand") {
  const Bytes bytes = golden("two");
  const auto view = FileView::open(bytes);
  REQUIRE(view);
  REQUIRE(validate(*view));
  CHECK(view->header().n_gaussians == 2);
  CHECK(view->header().n_chunks == 1);
  CHECK(view->header().n_step_sets == 1);
  CHECK(view->header().chunk_size == 256);
  CHECK(view->header().sh_degree == 0);
  CHECK(view->header().scale_exponent == 0);
  const Declarations& d = view->declarations();
  CHECK(d.z_near == 0.25f);
  CHECK(d.z_far == 64.f);
  CHECK(d.depth_source == DepthSource::by_hand);
  CHECK(d.order == Order::input);
  CHECK(d.full.min == std::array{-3.f, -2.f, 0.25f});
  CHECK(d.full.max == std::array{1.f, 4.f, 0.5f});
  CHECK(d.n_source == 2);
  CHECK(d.n_opacity_one == 1);
  CHECK(d.n_opacity_zero == 0);
  const auto chunk = view->chunk(0);
  REQUIRE(chunk);
  CHECK(chunk->means.min == d.full.min);
  CHECK(chunk->means.max == d.full.max);
  CHECK(chunk->radius == 3.f);
  CHECK(chunk->max_opacity == 1.f);
  CHECK(chunk->count == 2);
  const auto steps = view->step_set(0);
  REQUIRE(steps);
  CHECK(steps->step[0][0] == 1.f);
  CHECK(steps->step[0][1] == 1.f);
  CHECK(steps->step[0][2] == 0.f);

  std::vector<ActivatedSplat> splats(2);
  REQUIRE(view->read(0, splats));
  CHECK(std::to_array(splats[0].mean) == std::array{1.f, -2.f, 0.5f});
  CHECK(std::to_array(splats[0].rotation) == std::array{1.f, 0.f, 0.f, 0.f});
  CHECK(std::to_array(splats[0].scale) == std::array{1.f, 1.f, 1.f});
  CHECK(splats[0].opacity == 0.5f);
  CHECK(splats[0].sh[0] == 127.f);
  CHECK(splats[0].sh[1] == -127.f);
  CHECK(splats[0].sh[2] == 0.f);
  CHECK(splats[0].sh[3] == 0.f);
  CHECK(std::to_array(splats[1].mean) == std::array{-3.f, 4.f, 0.25f});
  CHECK(splats[1].rotation[0] == doctest::Approx(0.6).epsilon(1e-3));  // (-3, 0, 4, 0) / 5, negated for w >= 0
  CHECK(splats[1].rotation[1] == 0.f);
  CHECK(splats[1].rotation[2] == doctest::Approx(-0.8).epsilon(1e-3));
  CHECK(splats[1].rotation[3] == 0.f);
  CHECK(splats[1].opacity == 1.f);
  CHECK(splats[1].sh[0] == 2.f);
  CHECK(splats[1].sh[1] == 4.f);
  CHECK(splats[1].sh[2] == 0.f);

  std::vector<Splat> parameters(2);
  REQUIRE(view->read(0, parameters));
  CHECK(parameters[0].log_scale[1] == 0.f);
  CHECK(parameters[0].opacity_logit == 0.f);
  CHECK(parameters[1].opacity_logit == 9.0107908f);
  CHECK(parameters[1].rotation[0] == 0x1.334p-1f);  // 0.6 in FP16
}

TEST_CASE("every golden file decodes to its scene within the stated bounds") {
  for (const GoldenScene& scene : golden_scenes()) {
    if (scene.options.profile == Profile::archive) continue;  // which state their own bounds
    CAPTURE(scene.name);
    const Bytes bytes = golden(scene.name);
    const auto view = FileView::open(bytes);
    REQUIRE(view);
    REQUIRE(validate(*view));
    const Header& h = view->header();
    const SplatView source = scene.cloud.view();
    const bool edges = scene.name.ends_with("edges");
    CHECK(h.n_gaussians == source.n - (edges ? 1 : 0));
    CHECK(h.sh_degree == source.sh_degree);
    CHECK(h.chunk_size == scene.options.chunk_size);
    CHECK(view->declarations().axes == scene.options.axes);
    CHECK(view->declarations().colour_space == scene.options.colour_space);
    CHECK(view->declarations().aa_mode == scene.options.aa_mode);
    CHECK(view->declarations().depth_mapping == scene.options.depth_mapping);
    CHECK(view->declarations().order == scene.options.order);
    CHECK(view->declarations().metres_per_unit == scene.options.metres_per_unit);
    CHECK(view->declarations().n_dropped == (edges ? 1 : 0));

    std::map<std::array<float, 3>, std::uint64_t> by_mean;  // the source's index: no two means are equal
    for (std::uint64_t i = 0; i < source.n; ++i) {
      by_mean[{source.mean[3 * i], source.mean[3 * i + 1], source.mean[3 * i + 2]}] = i;
    }
    std::vector<ActivatedSplat> splats(h.n_gaussians);
    REQUIRE(view->read(0, splats));
    std::set<std::uint64_t> seen;
    for (std::uint64_t i = 0; i < splats.size(); ++i) {
      CAPTURE(i);
      const ActivatedSplat& a = splats[i];
      REQUIRE(by_mean.count(std::to_array(a.mean)) == 1);
      const std::uint64_t from = by_mean[std::to_array(a.mean)];
      CHECK(seen.insert(from).second);
      if (scene.options.keep_permutation) CHECK(view->source_index(i) == from);
      const Splat s = source.splat(from);
      const double unit = std::ldexp(1.0, -25 - h.scale_exponent);
      for (int k = 0; k < 3; ++k) {
        const double scale = std::exp(static_cast<double>(s.log_scale[k]));
        CHECK(std::abs(a.scale[k] - scale) <= std::max(scale * 0x1.001p-11, unit));
      }
      const double opacity = 1 / (1 + std::exp(-static_cast<double>(s.opacity_logit)));
      CHECK(std::abs(a.opacity - opacity) <= std::max(opacity * 0x1.001p-11, 0x1p-25));
      double dot = 0, norm = 0;
      for (int k = 0; k < 4; ++k) {
        dot += static_cast<double>(a.rotation[k]) * s.rotation[k];
        norm += static_cast<double>(s.rotation[k]) * s.rotation[k];
      }
      CHECK(std::abs(dot) / std::sqrt(norm) > 1 - 1e-6);
      const auto steps = view->chunk_steps(i / h.chunk_size);
      REQUIRE(steps);
      for (int k = 0; k < 48; ++k) {
        const float expected = k < 3 * sh_coefficients(h.sh_degree) ? s.sh[k] : 0.f;
        CHECK(std::abs(a.sh[k] - expected) <= 0.5f * steps->of_value(k) + 1e-6f);
      }
    }
  }
}

TEST_CASE("every golden archive of version 1.2 decodes to its scene within its stated bounds") {
  for (const GoldenScene& scene : golden_scenes()) {
    if (scene.options.profile != Profile::archive || !scene.earlier) continue;
    CAPTURE(scene.name);
    const Bytes bytes = golden(scene.name);
    const auto view = FileView::open(bytes);
    REQUIRE(view);
    REQUIRE(validate(*view));
    const SplatView source = scene.cloud.view();
    REQUIRE(view->header().n_gaussians == source.n);
    std::vector<ActivatedSplat> splats(source.n);
    REQUIRE(view->read(0, splats));

    const std::uint64_t arch = section_of(bytes, "ARCH"), n_classes = get<std::uint32_t>(bytes, arch + 8);
    float bound[4] = {0, 0, 0, 0};  // rotation, scale, SH of degree 0, others: the maximum over all classes
    for (std::uint64_t c = 0; c < n_classes; ++c) {
      for (std::uint64_t k = 0; k < 4; ++k) {
        bound[k] = std::max(bound[k], get<float>(bytes, arch + 128 + 36 * c + 20 + 4 * k));
      }
    }
    for (std::uint64_t i = 0; i < source.n; ++i) {
      CAPTURE(i);
      const ActivatedSplat& a = splats[i];
      const Splat s = source.splat(view->source_index(i));
      for (std::uint64_t k = 0; k < 3; ++k) {
        const auto centre = get<double>(bytes, arch + 24 + 8 * k), half_width = get<double>(bytes, arch + 48 + 8 * k);
        const double mean = a.mean[k], reach = std::max(half_width, std::abs(mean - centre));
        CHECK(std::abs(mean - s.mean[k]) <= get<float>(bytes, arch + 96) * reach);
        CHECK(std::abs(std::log(a.scale[k]) - s.log_scale[k]) <= bound[1] + 1e-6);
      }
      const double opacity = 1 / (1 + std::exp(-static_cast<double>(s.opacity_logit)));
      CHECK(std::abs(a.opacity - opacity) <= get<float>(bytes, arch + 100) + 1e-6);
      double dot = 0, norm = 0;
      for (int k = 0; k < 4; ++k) {
        dot += static_cast<double>(a.rotation[k]) * s.rotation[k];
        norm += static_cast<double>(s.rotation[k]) * s.rotation[k];
      }
      CHECK(2 * std::acos(std::min(1.0, std::abs(dot) / std::sqrt(norm))) <= bound[0] + 1e-3);  // acos near 1
      const ShStepSet steps = view->chunk_steps(i / view->header().chunk_size).value();
      for (int k = 0; k < 3 * sh_coefficients(source.sh_degree); ++k) {
        CHECK(std::abs(a.sh[k] - s.sh[k]) <= bound[k < 3 ? 2 : 3] + 0.5f * steps.of_value(k) + 1e-6f);
      }
    }
  }
}

TEST_CASE("every golden archive of version 1.5 decodes to its scene within its stated bounds") {
  for (const GoldenScene& scene : golden_scenes()) {
    if (scene.options.profile != Profile::archive || scene.earlier) continue;
    CAPTURE(scene.name);
    const Bytes bytes = golden(scene.name);
    const auto view = FileView::open(bytes);
    REQUIRE(view);
    REQUIRE(validate(*view));
    CHECK(view->header().version_minor == 5);
    const SplatView source = scene.cloud.view();
    REQUIRE(view->header().n_gaussians == source.n);
    std::vector<ActivatedSplat> splats(source.n);
    REQUIRE(view->read(0, splats));
    const StatedBounds bounds(bytes);
    for (std::uint64_t i = 0; i < source.n; ++i) {
      CAPTURE(i);
      const ShStepSet steps = view->chunk_steps(i / view->header().chunk_size).value();
      const auto step = [&steps](int k) { return steps.of_value(k); };
      CHECK(is_within(bounds, 0, source.sh_degree, source.splat(view->source_index(i)), splats[i], step));
    }
  }
}

TEST_CASE("every page of the golden archive with levels holds its Gaussians within the stated bounds") {
  for (const GoldenLevels& scene : all_golden_levels()) {
    if (scene.options.profile != Profile::archive || scene.earlier) continue;
    CAPTURE(scene.name);
    check_pages_within_bounds(golden(scene.name), scene);
  }
}

TEST_CASE("golden files have the scale sets and optional sections that they test") {
  const Bytes chunked_bytes = golden("degree3"), global_bytes = golden("global"), optional_bytes = golden("optional"),
              edges_bytes = golden("edges"), empty_bytes = golden("empty");
  const auto chunked = FileView::open(chunked_bytes);
  REQUIRE(chunked);
  CHECK(chunked->header().n_chunks == 2);
  CHECK(chunked->header().n_step_sets == 2);
  CHECK(chunked->chunk(1)->step_set == 1);
  CHECK(chunked->chunk(1)->count == 8);
  CHECK(chunked->chunk_steps(1)->of_value(47) == chunked->step_set(1)->step[3][2]);
  CHECK(chunked->chunk_steps(1)->of_value(47) != chunked->step_set(0)->step[3][2]);
  const auto global = FileView::open(global_bytes);
  REQUIRE(global);
  CHECK(global->header().n_step_sets == 1);
  CHECK(global->chunk(1)->step_set == 0);
  CHECK(global->chunk_steps(1)->of_value(3) == global->step_set(0)->step[1][0]);
  const auto optional = FileView::open(optional_bytes);
  REQUIRE(optional);
  REQUIRE(optional->provenance());
  CHECK(optional->provenance()->source_bytes == 1234);
  CHECK(optional->provenance()->source_xxh3 == 0x0123456789ABCDEFu);
  CHECK(optional->provenance()->source_name == "garden.ply");
  CHECK(optional->provenance()->tool == "golden 1");
  const Bytes crs_bytes = golden("crs");
  const auto crs = FileView::open(crs_bytes);
  REQUIRE(crs);
  CHECK(crs->header().version_minor == 5);
  CHECK(crs->declarations().crs.text == "GEODCRS[\"Z\u00fcrich \U0001f30d\", CS[Cartesian, 3]]");
  CHECK(crs->declarations().crs.axes == std::array{Axis::right, Axis::forward, Axis::up});
  for (const bool with_levels : {false, true}) {
    const Bytes view_bytes = golden(with_levels ? "levels_first_view" : "first_view");
    const auto paged = PagedFile::open(view_bytes);
    const auto plain = FileView::open(view_bytes);
    REQUIRE((with_levels ? paged.has_value() : plain.has_value()));
    const FileView& viewed = with_levels ? paged->head() : *plain;
    CHECK(viewed.header().version_minor == 5);
    const FirstView expected =
        with_levels ? FirstView{ViewKind::outside, {0, -12, -24}, {0, 0, 0.5F}, {0, -1, 0}, 60}
                    : FirstView{ViewKind::inside, {1.5F, -2, 0.25F}, {-3, -1.5F, 8}, {0.6F, -0.8F, 0}, 75};
    CHECK(viewed.declarations().first_view == expected);
    CHECK(keep_declarations({}, viewed.declarations()).first_view == expected);
  }
  CHECK(crs->declarations().first_view == FirstView());
  const auto edges = FileView::open(edges_bytes);
  REQUIRE(edges);
  CHECK(edges->declarations().n_scale_zero != 0);
  CHECK(edges->declarations().n_scale_subnormal != 0);
  CHECK(edges->declarations().n_opacity_one == 1);
  CHECK(edges->declarations().n_opacity_zero == 1);
  CHECK(edges->declarations().full.max[0] == 65536.f);
  CHECK(edges->declarations().robust.max[0] < 16.f);
  const auto empty = FileView::open(empty_bytes);
  REQUIRE(empty);
  CHECK(empty->header().n_gaussians == 0);
  CHECK(empty->find(SectionType::means)->stored_bytes == 0);
}

TEST_CASE("the example of the specification is the golden file of two Gaussians") {
  std::ifstream document(fs::path(source_dir()) / "docs/format/FORMAT_EXAMPLE.md");
  REQUIRE(document);
  // Dump lines: indent, offset of 8 hex digits, up to 16 bytes of 2, two spaces, explanation. Omitted lines are zero.
  Bytes bytes(golden("two").size());
  std::size_t lines = 0;
  std::vector<bool> printed(bytes.size());
  for (std::string line; std::getline(document, line);) {
    if (line.size() < 15 || line.compare(0, 4, "    ") != 0) continue;
    const std::string digits = line.substr(4, 8);
    if (line[12] != ' ' || digits.find_first_not_of("0123456789ABCDEF") != std::string::npos) continue;
    std::size_t at = std::stoul(digits, nullptr, 16);
    for (std::size_t i = 12; i + 2 < line.size() && line[i] == ' ' && line[i + 1] != ' '; i += 3) {
      REQUIRE(at < bytes.size());
      CHECK_FALSE(printed[at]);
      printed[at] = true;
      bytes[at++] = static_cast<std::byte>(std::stoul(line.substr(i + 1, 2), nullptr, 16));
    }
    ++lines;
  }
  CHECK(lines > 40);
  CHECK(bytes == golden("two"));
}

TEST_CASE("each file with one defect causes the listed error at the listed offset") {
  const fs::path folder = kGolden / "reject";
  std::ifstream list(folder / "reject.txt");
  REQUIRE(list);
  std::map<std::string, RejectCase> cases;
  for (RejectCase& c : reject_cases(kGolden)) {
    CAPTURE(c.name);
    CHECK(cases.emplace(c.name + ".rgs", std::move(c)).second);
  }
  std::set<std::string> listed, codes;
  for (std::string line; std::getline(list, line);) {
    if (line.starts_with('#')) continue;
    std::istringstream words(line);
    std::string name, code;
    std::uint64_t offset = 0;
    words >> name >> code >> offset;
    CAPTURE(name);
    REQUIRE(words);
    CHECK(listed.insert(name).second);
    codes.insert(code);
    const Bytes bytes = read_bytes(folder / name);
    with_each_instruction_set([&] {
      const auto cloud = decode(bytes);
      REQUIRE_FALSE(cloud);
      CHECK(std::string(errc_name(cloud.error().code)) == code);
      CHECK(cloud.error().offset == offset);
    });
    REQUIRE(cases.count(name) == 1);
    if (same_library(Profile::archive) || get<std::uint16_t>(bytes, 10) == 0) CHECK(cases.at(name).bytes == bytes);
    CHECK(std::string(errc_name(cases.at(name).code)) == code);
    CHECK(cases.at(name).offset == offset);
  }
  CHECK(listed.size() == cases.size());
  for (const auto& entry : fs::directory_iterator(folder)) {
    if (entry.path().extension() == ".rgs") CHECK(listed.count(entry.path().filename()) == 1);
  }
  for (auto code = static_cast<int>(Errc::truncated); code <= static_cast<int>(Errc::bad_value); ++code) {
    const std::string name = errc_name(static_cast<Errc>(code));
    CAPTURE(name);
    CHECK(codes.count(name) == 1);
  }
}

TEST_CASE("validation in steps gives the result of validation at once") {
  std::size_t n_refused = 0;
  for (const fs::path& folder : {kGolden, kGolden / "reject"}) {
    for (const auto& entry : fs::directory_iterator(folder)) {
      if (entry.path().extension() != ".rgs") continue;
      CAPTURE(entry.path().string());
      const Bytes bytes = read_bytes(entry.path());
      const auto view = FileView::open(bytes);
      if (!view) continue;
      const auto in_steps = [&](Result<Validation> validation) -> Status {
        if (!validation) return tl::unexpected(validation.error());
        for (std::uint64_t chunk = 0; chunk < view->header().n_chunks; ++chunk) {
          const auto data = read_chunks(*view, chunk, 1, {.validate = false});
          if (!data) return tl::unexpected(data.error());
          if (Status s = validation->check(*data); !s) return s;
        }
        return validation->finish();
      };
      const Status at_once = validate(*view), steps = in_steps(Validation::begin(*view)),
                   early = in_steps(Validation::begin_early(*view));
      REQUIRE(steps.has_value() == at_once.has_value());
      REQUIRE(early.has_value() == at_once.has_value());
      if (at_once) continue;
      ++n_refused;
      CHECK(steps.error().code == at_once.error().code);
      CHECK(steps.error().offset == at_once.error().offset);
      // Values are checked before their section's hash.
      if (at_once.error().code != Errc::checksum_mismatch) CHECK(early.error().code == at_once.error().code);
    }
  }
  CHECK(n_refused > 40);
}

TEST_CASE("a file is decoded while its large sections are still arriving") {
  for (const char* name : {"degree3.rgs", "packed_degree2.rgs", "archive_degree1.rgs", "archive3_degree2.rgs"}) {
    CAPTURE(name);
    const Bytes whole = read_bytes(kGolden / name);
    const auto complete = FileView::open(whole);
    REQUIRE(complete);
    Bytes coming = whole;
    for (const SectionType type : {SectionType::means, SectionType::geometry, SectionType::sh}) {
      const SectionEntry& entry = *complete->find(type);
      const auto& frames = complete->frames(type).frames;
      const std::uint64_t begin = frames.empty() ? entry.offset : frames.front().offset;
      std::fill(coming.begin() + static_cast<std::ptrdiff_t>(begin),
                coming.begin() + static_cast<std::ptrdiff_t>(entry.offset + entry.stored_bytes), std::byte{0});
    }
    REQUIRE(coming != whole);
    CHECK_FALSE(validate(*FileView::open(coming)));
    const auto view = FileView::open(coming);
    REQUIRE(view);
    auto validation = Validation::begin_early(*view);
    REQUIRE(validation);
    std::ranges::copy(whole, coming.begin());
    const auto data = read_chunks(*view, 0, view->header().n_chunks, {.validate = false});
    REQUIRE(data);
    CHECK(std::ranges::equal(data->means(), load_direct(*complete)->means()));
    CHECK(validation->check(*data));
    CHECK(validation->finish());
    // The section's hash reveals what no frame and no value shows.
    coming.back() ^= std::byte{1};
    CHECK_FALSE(validation->finish());
  }
}
