// declarations_test.cpp - a scene's declarations on their way through rgs-convert.
// SPDX-License-Identifier: Apache-2.0
#include <array>
#include <nlohmann/json.hpp>

#include "archive_bounds.hpp"
#include "convert_program.hpp"
#include "convert_scenes.hpp"
#include "interchange_samples.hpp"
#include "rgs/paged_file.hpp"
#include "rgs/ply.hpp"
#include "rgs/splat_edit.hpp"
#include "run_program.hpp"
#include "temporary_folder.hpp"

using namespace rgs;
using namespace rgs::test;

namespace {

struct RgsFile {
  explicit RgsFile(const std::string& path) : bytes(read_bytes(path)) {
    const auto view = FileView::open(bytes);
    REQUIRE(view);
    REQUIRE(validate(*view));
    d = view->declarations();
    provenance = view->provenance();
    if (view->find(SectionType::permutation) == nullptr) return;
    for (std::uint64_t i = 0; i < view->header().n_gaussians; ++i) source_index.push_back(view->source_index(i));
  }
  SplatCloud cloud() const { return decode(bytes).value(); }

  Bytes bytes;
  Declarations d;
  std::optional<Provenance> provenance;
  std::vector<std::uint64_t> source_index;
};

// Every declaration, none at its default.
EncodeOptions unusual_options() {
  EncodeOptions o;
  o.aa_mode = AaMode::mip_splatting;
  o.low_pass_px2 = 0.2F;
  o.colour_space = ColourSpace::linear_display;
  o.metres_per_unit = 0.5F;
  o.cutoff_sigma = 2.5F;
  o.alpha_max = 0.999F;
  o.depth = DepthRange{0.5F, 32, DepthSource::cameras};
  o.depth_mapping = DepthMapping::linear;
  return o;
}

std::string write_rgs(const std::string& path, const SplatCloud& cloud, const EncodeOptions& options) {
  write_bytes(path, encode(cloud.view(), options).value());
  return path;
}

bool holds(const nlohmann::json& texts, const std::string& part) {
  return std::ranges::any_of(
      texts, [&](const auto& t) { return t.template get<std::string>().find(part) != std::string::npos; });
}

}  // namespace

TEST_CASE("the anti-aliasing flag of an SPZ survives PLY, compressed PLY, SOG, glTF and OpenUSD") {
  const TemporaryFolder folder;
  const SplatCloud cloud = ordinary_cloud(300, 1, 1);
  const std::string spz = folder.file("scene.spz"), rgs = folder.file("scene.rgs");
  for (const AaMode mode : {AaMode::classic, AaMode::mip_splatting}) {
    write_bytes(spz, encode_splats(cloud.view(), SplatFormat::spz, {.aa_mode = mode}).value());
    for (const std::string between : {"ply", "compressed.ply", "glb", "usda", "rgs", "spz", "sog"}) {
      CAPTURE(between);
      const std::string file = folder.file("between." + between);
      CHECK(converted({spz, file})["lost"] == nlohmann::json::array());
      converted({file, rgs});
      CHECK(RgsFile(rgs).d.aa_mode == mode);
      CHECK(RgsFile(rgs).d.low_pass_px2 == default_low_pass_px2(mode));
    }
  }
  // .splat cannot hold it, and says so.
  const auto json = converted({spz, folder.file("scene.splat")});
  CHECK(json["declared"]["anti_aliasing"] == "mip-splatting");
  CHECK(json["declared"]["low_pass_px2"] == 0.1);
  CHECK(holds(json["lost"], "anti-aliasing"));
  const ProgramResult text = rgs_convert({spz, folder.file("scene.splat")});
  CHECK(text.out.find("anti-aliasing") != std::string::npos);
}

TEST_CASE("the low-pass is declared by option, else by the anti-aliasing, and stays with the scene") {
  const TemporaryFolder folder;
  const std::string ply = write_scene(folder.file("scene.ply"), ordinary_cloud(100, 0, 2)),
                    rgs = folder.file("scene.rgs"), again = folder.file("again.rgs");
  const auto declared = [&](std::vector<std::string> options, const std::string& input) {
    options.insert(options.end(), {input, again});
    converted(options);
    return std::pair(RgsFile(again).d.aa_mode, RgsFile(again).d.low_pass_px2);
  };
  using Pair = std::pair<AaMode, float>;
  CHECK(declared({}, ply) == Pair{AaMode::classic, 0.3F});
  CHECK(declared({"--aa", "mip-splatting"}, ply) == Pair{AaMode::mip_splatting, 0.1F});
  CHECK(declared({"--aa", "mip"}, ply) == Pair{AaMode::mip_splatting, 0.1F});
  CHECK(declared({"--aa-mode", "mip-splatting"}, ply) == Pair{AaMode::mip_splatting, 0.1F});
  CHECK(declared({"--aa", "mip", "--low-pass", "0.3"}, ply) == Pair{AaMode::mip_splatting, 0.3F});
  CHECK(declared({"--low-pass", "0"}, ply) == Pair{AaMode::classic, 0.F});
  converted({"--aa", "mip", "--low-pass", "0.25", ply, rgs});
  CHECK(declared({}, rgs) == Pair{AaMode::mip_splatting, 0.25F});
  CHECK(declared({"--aa", "mip"}, rgs) == Pair{AaMode::mip_splatting, 0.25F});
  CHECK(declared({"--aa", "classic"}, rgs) == Pair{AaMode::classic, 0.3F});
  CHECK(declared({"--low-pass", "0.1"}, rgs) == Pair{AaMode::mip_splatting, 0.1F});
  CHECK(rgs_convert({"--low-pass", "-1", ply, again}).exit_code == 2);
  CHECK(rgs_convert({"--low-pass", "nan", ply, again}).exit_code == 2);
  // Without a declared mode a low-pass has no meaning.
  CHECK(rgs_convert({"--aa", "undeclared", "--low-pass", "0.1", ply, again}).exit_code == 2);
  converted({"--aa", "undeclared", ply, rgs});
  CHECK(declared({}, rgs) == Pair{AaMode::undeclared, 0.3F});
  const ProgramResult refused = rgs_convert({"--low-pass", "0.1", rgs, again});
  CHECK(refused.exit_code == 2);
  CHECK(refused.err.find("--aa") != std::string::npos);
}

TEST_CASE("PLY and glTF carry declarations without a common form in names of ours, and read them back") {
  const TemporaryFolder folder;
  const SplatCloud cloud = ordinary_cloud(200, 1, 3);
  const std::string rgs = write_rgs(folder.file("scene.rgs"), cloud, unusual_options()), back = folder.file("back.rgs");
  for (const std::string between : {"ply", "compressed.ply", "glb"}) {
    for (const std::string filter : {"", "--min-opacity=0.001"}) {  // streamed, and not
      CAPTURE(between);
      CAPTURE(filter);
      const std::string file = folder.file("between." + between);
      const auto json = filter.empty() ? converted({rgs, file}) : converted({filter, rgs, file});
      REQUIRE(json["lost"].size() == 2);
      CHECK(holds(json["lost"], "depth range"));
      CHECK(holds(json["lost"], "thresholds"));
      converted({file, back});
      const Declarations d = RgsFile(back).d;
      CHECK(d.aa_mode == AaMode::mip_splatting);
      CHECK(d.low_pass_px2 == 0.2F);
      CHECK(d.colour_space == ColourSpace::linear_display);
      CHECK(d.metres_per_unit == 0.5F);
      CHECK(d.axes == kAxes3dgs);
    }
  }
  // A format reports what it cannot hold.
  for (const std::string to : {"spz", "splat"}) {
    CAPTURE(to);
    const auto lost = converted({rgs, folder.file("lossy." + to)})["lost"];
    CHECK(holds(lost, "low-pass"));
    CHECK(holds(lost, "colour space"));
    CHECK(holds(lost, "metres per unit"));
    CHECK(holds(lost, "anti-aliasing") == (to == "splat"));
  }
  // Undeclared stays undeclared.
  EncodeOptions undeclared;
  undeclared.axes.fill(Axis::undeclared);
  undeclared.colour_space = ColourSpace::undeclared;
  undeclared.aa_mode = AaMode::undeclared;
  write_rgs(rgs, cloud, undeclared);
  for (const std::string between : {"ply", "compressed.ply", "glb"}) {
    CAPTURE(between);
    const std::string file = folder.file("between." + between);
    CHECK(converted({rgs, file})["lost"].empty());
    converted({file, back});
    CHECK(RgsFile(back).d.axes == undeclared.axes);
    CHECK(RgsFile(back).d.colour_space == ColourSpace::undeclared);
    CHECK(RgsFile(back).d.aa_mode == AaMode::undeclared);
  }
  // Axes other than 3DGS's are stated, so that nobody turns the scene twice.
  const std::string turned = folder.file("turned.ply");
  converted({"--to-axes", "opengl", write_scene(folder.file("plain.ply"), cloud), turned});
  converted({"--keep-order", turned, back});
  CHECK(RgsFile(back).d.axes == kAxesOpenGl);
  SplatCloud expected = cloud;
  convert_axes(expected, kAxes3dgs, kAxesOpenGl);
  CHECK(RgsFile(back).cloud().mean == expected.mean);
  CHECK(read_splats(turned)->cloud.mean == cloud.mean);
}

TEST_CASE("a PLY of default declarations has no comment, and other programs' comments are understood") {
  const TemporaryFolder folder;
  const SplatCloud cloud = ordinary_cloud(50, 0, 4);
  const std::string ply = write_scene(folder.file("scene.ply"), cloud), rgs = folder.file("scene.rgs"),
                    back = folder.file("back.ply");
  converted({ply, rgs});
  converted({rgs, back});
  CHECK(text_of(read_bytes(back)).find("comment") == std::string::npos);
  const std::string plain = text_of(read_bytes(ply)), format = "format binary_little_endian 1.0\n";
  const std::size_t at = plain.find(format) + format.size();
  const auto mode_of = [&](const std::string& comments) {
    write_text(ply, std::string(plain).insert(at, comments));
    converted({ply, rgs});
    return RgsFile(rgs).d.aa_mode;
  };
  const AaMode mip = AaMode::mip_splatting, classic = AaMode::classic;
  CHECK(mode_of("comment SplatRenderMode: mip\n") == mip);
  CHECK(mode_of("comment   SPLATRENDERMODE:  MIP  \r\n") == mip);
  CHECK(mode_of("comment Exported from Brush\ncomment SplatRenderMode: default\n") == classic);
  CHECK(mode_of("comment SplatRenderMode mip\n") == mip);
  CHECK(mode_of("comment antialiased 1\n") == mip);
  CHECK(mode_of("comment antialiased 0\n") == classic);
  CHECK(mode_of("comment SplatRenderMode: mip\ncomment antialiased 0\n") == classic);
  CHECK(mode_of("comment SplatRenderMode: banana\ncomment antialiased\ncomment\ncomment rgs_later: 1\n") == classic);
  for (const char* wrong : {"rgs_low_pass_px2: wide", "rgs_low_pass_px2: -1", "rgs_metres_per_unit: nan",
                            "rgs_axes: up", "rgs_axes: up,down,left", "rgs_colour_space: red", "rgs_anti_aliasing:"}) {
    CAPTURE(wrong);
    write_text(ply, std::string(plain).insert(at, std::string("comment ") + wrong + "\n"));
    const ProgramResult run = rgs_convert({ply, rgs});
    CHECK(run.exit_code == 4);
    CHECK(run.err.find("byte " + std::to_string(at)) != std::string::npos);
  }
}

TEST_CASE(".rgs to .rgs keeps every declaration, in units of the new scene") {
  const TemporaryFolder folder;
  const SplatCloud cloud = ordinary_cloud(300, 1, 5);
  const std::string rgs = write_rgs(folder.file("scene.rgs"), cloud, unusual_options()), out = folder.file("out.rgs");
  const auto after = [&](std::vector<std::string> options) {
    options.insert(options.end(), {rgs, out});
    converted(options);
    return RgsFile(out).d;
  };
  for (const std::vector<std::string>& options :
       {std::vector<std::string>{}, {"--profile", "archive"}, {"--crop=-4,-4,-4,4,4,4"}, {"--sh-degree", "0"}}) {
    CAPTURE(options);
    const Declarations d = after(options);
    CHECK(d.aa_mode == AaMode::mip_splatting);
    CHECK(d.low_pass_px2 == 0.2F);
    CHECK(d.colour_space == ColourSpace::linear_display);
    CHECK(d.metres_per_unit == 0.5F);
    CHECK(d.cutoff_sigma == 2.5F);
    CHECK(d.alpha_max == 0.999F);
    CHECK(d.z_near == 0.5F);
    CHECK(d.z_far == 32);
    CHECK(d.depth_source == DepthSource::cameras);
    CHECK(d.depth_mapping == DepthMapping::linear);
  }
  // Twice as many units for the same length.
  Declarations d = after({"--scale", "2"});
  CHECK(d.metres_per_unit == 0.25F);
  CHECK(d.z_near == 1);
  CHECK(d.z_far == 64);
  CHECK(d.depth_source == DepthSource::cameras);
  // Options take precedence.
  d = after({"--scale", "2", "--metres-per-unit", "3", "--near", "0.125", "--depth-map", "log"});
  CHECK(d.metres_per_unit == 3);
  CHECK(d.z_near == 0.125F);
  CHECK(d.z_far == 64);
  CHECK(d.depth_source == DepthSource::by_hand);
  CHECK(d.depth_mapping == DepthMapping::logarithmic);
  CHECK(after({"--metres-per-unit", "0"}).metres_per_unit == 0);
  // A depth range from the scene's extent belongs to its mapping.
  EncodeOptions linear;
  linear.depth_mapping = DepthMapping::linear;
  const auto extent = FileView::open(encode(cloud.view(), {}).value())->declarations();
  write_rgs(rgs, cloud, linear);
  d = after({"--depth-map", "log"});
  CHECK(d.z_far == extent.z_far);
  CHECK(d.depth_source == DepthSource::scene_extent);
}

TEST_CASE("merged inputs with different declarations: the first is taken and reported") {
  const TemporaryFolder folder;
  const SplatCloud cloud = ordinary_cloud(100, 0, 6);
  EncodeOptions other = unusual_options();
  other.aa_mode = AaMode::classic;
  other.low_pass_px2 = 0.3F;
  other.metres_per_unit = 2;
  other.depth = DepthRange{1, 50, DepthSource::by_hand};
  const std::string a = write_rgs(folder.file("a.rgs"), cloud, unusual_options()),
                    b = write_rgs(folder.file("b.rgs"), cloud, other), out = folder.file("out.rgs");
  auto json = converted({"--merge", a, b, out});
  const Declarations d = RgsFile(out).d;
  CHECK(d.aa_mode == AaMode::mip_splatting);
  CHECK(d.low_pass_px2 == 0.2F);
  CHECK(d.metres_per_unit == 0.5F);
  CHECK(d.depth_source == DepthSource::scene_extent);
  CHECK(d.n_source == 200);
  CHECK(holds(json["notes"], "anti-aliasing"));
  CHECK(holds(json["notes"], "metres per unit"));
  CHECK(holds(json["notes"], "depth range"));
  CHECK(holds(json["notes"], "b.rgs"));
  CHECK(rgs_convert({"--merge", a, b, out}).out.find("anti-aliasing") != std::string::npos);
  // Scaled to one unit by --scale they agree; a value set by an option needs no note.
  json = converted({"--merge", "--scale", "1", "--scale", "4", "--aa", "classic", a, b, out});
  CHECK_FALSE(holds(json["notes"], "metres per unit"));
  CHECK_FALSE(holds(json["notes"], "anti-aliasing"));
  CHECK(RgsFile(out).d.metres_per_unit == 0.5F);
  json = converted({"--merge", a, a, out});
  CHECK(json["notes"].empty());
  CHECK(RgsFile(out).d.z_far == 32);
}

TEST_CASE("a coordinate reference system goes with the scene, and is lost or refused where it no longer holds") {
  const TemporaryFolder folder;
  const SplatCloud cloud = ordinary_cloud(300, 0, 8);
  EncodeOptions options;
  options.origin = {4.2e6, 1.7e5, 4.8e6};
  options.crs = {"EPSG:4978", {}};
  const std::string a = write_rgs(folder.file("a.rgs"), cloud, options), out = folder.file("out.rgs");
  options.crs.text = "EPSG:9988";
  const std::string b = write_rgs(folder.file("b.rgs"), cloud, options);
  options.crs = {};
  const std::string none = write_rgs(folder.file("none.rgs"), cloud, options);
  const Crs ecef{"EPSG:4978", {}};
  for (const std::string profile : {"direct", "packed", "archive:high"}) {
    CAPTURE(profile);
    CHECK(converted({"--profile", profile, a, out})["declared"]["crs"] == "EPSG:4978");
    CHECK(RgsFile(out).d.crs == ecef);
  }
  converted({"--lod", "--chunk-size", "32", a, out});
  Bytes bytes = read_bytes(out);
  CHECK(PagedFile::open(bytes)->head().declarations().crs == ecef);
  converted({"--level-of-detail", "0", out, folder.file("finest.rgs")});
  CHECK(RgsFile(folder.file("finest.rgs")).d.crs == ecef);
  converted({"--merge", a, none, a, out});
  CHECK(RgsFile(out).d.crs == ecef);
  // Its axes stay those of the coordinates.
  converted({"--to-axes", "opengl", a, out});
  const std::string turned = folder.file("turned.rgs");
  CHECK(RgsFile(out).d.crs == Crs{"EPSG:4978", kAxes3dgs});
  for (const std::string name : {"undeclared.rgs", "undeclared.ply"}) {
    CAPTURE(name);
    CHECK(holds(converted({"--axes", "undeclared", out, folder.file(name)})["notes"], "was turned since"));
    CHECK(read_splats(folder.file(name)).value().crs == Crs());
  }
  converted({"--to-axes", "3dgs", out, turned});
  CHECK(RgsFile(turned).d.crs == ecef);
  for (const std::vector<std::string>& lod : {std::vector<std::string>{}, {"--lod"}}) {
    auto arguments = lod;
    arguments.insert(arguments.end(), {"--merge", a, b, out});
    const auto refused = rgs_convert(arguments);
    CHECK(refused.exit_code == 2);
    CHECK(refused.err.find("--crs") != std::string::npos);
    arguments.insert(arguments.begin(), {"--crs", "EPSG:7789"});
    converted(arguments);
  }
  CHECK(holds(converted({"--translate", "0,0,1", a, out})["notes"], "no longer in EPSG:4978"));
  CHECK(RgsFile(out).d.crs == Crs());
  converted({"--translate", "0,0,1", "--crs", "LOCAL:x", a, out});
  CHECK(RgsFile(out).d.crs == Crs{"LOCAL:x", {}});
  converted({"--crs", "none", a, out});
  bytes = read_bytes(out);
  CHECK(FileView::open(bytes)->find(SectionType::crs) == nullptr);
  CHECK(rgs_convert({"--crs", "a\nb", a, out}).exit_code == 2);
  // Comments of a PLY and extras of a glTF keep it, with its case and its axes.
  for (const std::string name : {"a.ply", "a.glb", "a.usda", "a.compressed.ply"}) {
    CAPTURE(name);
    const std::string kept = folder.file(name);
    std::vector<std::string> arguments{"--crs", "GEODCRS[\"Z\u00fcrich: rgs_crs\"]", a, kept};
    if (name == "a.compressed.ply") arguments.insert(arguments.begin(), "--allow-rounding");
    CHECK_FALSE(holds(converted(arguments)["lost"], "coordinate reference system"));
    ReadOptions as_stored;
    as_stored.keep_axes = true;
    const Crs stored = read_splats(kept, as_stored).value().crs;
    CHECK(stored.text == "GEODCRS[\"Z\u00fcrich: rgs_crs\"]");
    CHECK(stored.axes == (name == "a.glb" || name == "a.usda" ? kAxes3dgs : Axes{}));
    converted({kept, out});
    CHECK(RgsFile(out).d.crs == Crs{stored.text, {}});
  }
  converted({"--crs", " ", a, folder.file("blank.ply")});
  CHECK(read_splats(folder.file("blank.ply")).value().crs == Crs());
  const std::string text = read_text(folder.file("a.ply"));
  const std::size_t at = text.find("rgs_crs: ") + 9;
  write_text(folder.file("bad.ply"), text.substr(0, at) + "\x01" + text.substr(at + 1));
  CHECK(rgs_convert({folder.file("bad.ply"), folder.file("bad.rgs")}).exit_code == 4);
  CHECK(holds(converted({"--to", "npz", a, folder.file("a.npz")})["lost"], "EPSG:4978"));
}

TEST_CASE("the .prj of a PLY states its coordinate reference system if the PLY states none") {
  const TemporaryFolder folder;
  const SplatCloud cloud = ordinary_cloud(40, 0, 3);
  const std::string ply = write_scene(folder.file("a.ply"), cloud), out = folder.file("a.rgs");
  const std::string wkt = "PROJCS[\"a\",\n\tUNIT[\"metre\",1]]", line = "PROJCS[\"a\",  UNIT[\"metre\",1]]";
  const auto crs_of = [&](std::vector<std::string> arguments) {
    const auto json = converted(arguments);
    CHECK((json["notes"].dump().find("the .prj beside it is taken") != std::string::npos) ==
          (json["declared"]["crs"] == line));
    return json["declared"]["crs"].get<std::string>();
  };
  write_text(folder.file("b.prj"), wkt);
  CHECK(crs_of({ply, out}).empty());
  for (const std::string& text : {"\xEF\xBB\xBF" + wkt + "\r\n", wkt}) {
    write_text(folder.file("a.prj"), text);
    for (const char* output : {"a.rgs", "a.glb", "b.ply"}) {
      CHECK(crs_of({ply, folder.file(output)}) == line);
      CHECK(read_splats(folder.file(output)).value().crs.text == line);
    }
  }
  CHECK(crs_of({"--lod", ply, out}) == line);
  CHECK(crs_of({"--crs", "none", ply, out}).empty());
  CHECK(crs_of({"--crs", "EPSG:4978", ply, out}) == "EPSG:4978");
  CHECK(crs_of({"--crs", "EPSG:4978", "--translate", "0,0,1", ply, out}) == "EPSG:4978");
  CHECK(crs_of({out, folder.file("c.ply")}) == "EPSG:4978");
  write_text(folder.file("c.prj"), wkt);
  CHECK(crs_of({folder.file("c.ply"), out}) == "EPSG:4978");
  CHECK(rgs_convert({"--to", "ply", ply, folder.file("a.prj")}).exit_code == 2);
  for (const std::string& text :
       {std::string("Projection UTM"), std::string(), wkt + "\x01]", wkt + std::string(32768, ' ')}) {
    write_text(folder.file("a.prj"), text);
    CHECK(crs_of({ply, out}).empty());
  }
}

TEST_CASE("positions in the source refer to the original, through .rgs files and filters") {
  const TemporaryFolder folder;
  SplatCloud cloud = ordinary_cloud(400, 0, 7);
  cloud.mean[3 * 17] = std::numeric_limits<float>::quiet_NaN();
  const std::string ply = write_scene(folder.file("scene.ply"), cloud), one = folder.file("one.rgs"),
                    two = folder.file("two.rgs"), three = folder.file("three.rgs");
  const auto check = [&](const std::string& path, std::uint64_t n) {
    const RgsFile file(path);
    CAPTURE(path);
    CHECK(file.d.n_source == 400);
    CHECK(file.d.n_dropped == 400 - n);
    REQUIRE(file.source_index.size() == n);
    const SplatCloud there = file.cloud();
    const bool archive = FileView::open(file.bytes)->archive() != nullptr;
    for (std::uint64_t i = 0; i < n; ++i) {
      const double moved = std::abs(there.mean[3 * i] - cloud.mean[3 * file.source_index[i]]);
      REQUIRE(moved <= (archive ? reach_of_mean(StatedBounds(file.bytes), 0, there.view().splat(i)) : 0));
    }
    REQUIRE(file.provenance);
    CHECK(file.provenance->source_name == "scene.ply");
    CHECK(file.provenance->source_bytes == std::filesystem::file_size(ply));
  };
  converted({"--keep-permutation", ply, one});
  check(one, 399);
  for (const std::vector<std::string>& options :
       {std::vector<std::string>{}, {"--keep-order"}, {"--profile", "archive"}, {"--to-axes", "3dgs"}}) {
    std::vector<std::string> arguments{"--keep-permutation", one, two};
    arguments.insert(arguments.begin(), options.begin(), options.end());
    CAPTURE(arguments);
    CHECK(converted(arguments)["notes"].empty());
    check(two, 399);
    CHECK(RgsFile(two).provenance->source_xxh3 == RgsFile(one).provenance->source_xxh3);
  }
  // A filter states source positions too, from PLY and from .rgs.
  const std::uint64_t n = converted({"--keep-permutation", "--crop=-4,-4,-4,4,4,4", ply, two})["output"]["gaussians"];
  CHECK(n > 10);
  check(two, n);
  converted({"--keep-permutation", "--crop=-4,-4,-4,4,4,4", one, two});
  check(two, n);
  converted({"--keep-permutation", two, three});
  check(three, n);
  // Other formats restore the source's order, filtered or not.
  for (const std::string to : {"ply", "splat", "glb"}) {
    for (const std::string filter : {"--min-opacity=0", "--min-opacity=0.5"}) {
      CAPTURE(to);
      const std::string file = folder.file("ordered." + to);
      converted({filter, one, file});
      const SplatCloud ordered = read_splats(file).value().cloud;
      std::uint64_t at = 0;  // each Gaussian comes after the one before
      for (std::uint64_t i = 0; i < cloud.size() && at < ordered.size(); ++i) {
        if (std::abs(ordered.mean[3 * at] - cloud.mean[3 * i]) < 1e-6F) ++at;
      }
      CHECK(at == ordered.size());
      CHECK(ordered.size() > 100);
    }
  }
  // Without --keep-permutation they are lost, which is reported.
  CHECK(holds(converted({one, two})["lost"], "positions"));
  CHECK(RgsFile(two).d.n_source == 400);
  CHECK(RgsFile(two).d.n_dropped == 1);

  // A complete file in source order needs no permutation to know them.
  cloud.mean[3 * 17] = 1;
  write_scene(ply, cloud);
  converted({"--keep-order", ply, one});
  converted({"--keep-permutation", one, two});
  check(two, 400);
  // A file that lost them is its own source: positions, counts and provenance refer to it, which is reported.
  converted({"--crop=-4,-4,-4,4,4,4", ply, one});
  const auto json = converted({"--keep-permutation", one, two});
  CHECK(holds(json["notes"], "one.rgs"));
  const RgsFile own(two);
  CHECK(own.d.n_source == own.source_index.size());
  CHECK(own.d.n_dropped == 0);
  REQUIRE(own.provenance);
  CHECK(own.provenance->source_name == "one.rgs");
  CHECK(own.provenance->source_bytes == std::filesystem::file_size(one));
  const SplatCloud before = RgsFile(one).cloud(), now = own.cloud();
  for (std::uint64_t i = 0; i < now.size(); ++i) REQUIRE(now.mean[3 * i] == before.mean[3 * own.source_index[i]]);
}
