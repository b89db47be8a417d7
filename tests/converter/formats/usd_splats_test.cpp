// usd_splats_test.cpp - OpenUSD's .usda and .usdz: a file written by hand after the schema, round trips, transforms,
// every refusal at its byte, hostile files.
// SPDX-License-Identifier: Apache-2.0
#include <cmath>
#include <numbers>

#include "checkout.hpp"
#include "complexity.hpp"
#include "interchange_samples.hpp"
#include "rgs/splat_edit.hpp"
#include "zip_samples.hpp"

using namespace rgs;
using namespace rgs::test;

namespace {

constexpr Axes kAxesUpZ{Axis::right, Axis::forward, Axis::up};

std::string replaced(std::string text, const std::string& from, const std::string& to) {
  const std::size_t at = text.find(from);
  REQUIRE(at != text.npos);
  return text.replace(at, from.size(), to);
}

// One Gaussian, with these lines in its prim and around it.
std::string stage(const std::string& in_prim, const std::string& head = "", const std::string& around = "%") {
  const std::string prim =
      "def ParticleField3DGaussianSplat \"S\" {\n  point3f[] positions = [(1, 2, 3)]\n" + in_prim + "\n}\n";
  return "#usda 1.0\n" + head + replaced(around, "%", prim);
}

SplatFile read_text(const std::string& text) {
  auto file = read_splats(bytes_of(text), kKeepAxes);
  if (!file) FAIL(file.error().what << " at " << file.error().offset << " of\n" << text);
  return *std::move(file);
}

void check_near(std::span<const float> found, std::initializer_list<double> expected, double tolerance = 1e-6) {
  REQUIRE(found.size() == expected.size());
  std::size_t i = 0;
  for (const double value : expected) CHECK(std::abs(static_cast<double>(found[i++]) - value) <= tolerance);
}

}  // namespace

TEST_CASE("usda: a file written by hand after the schema has the values that it says") {
  const std::string path = source_dir() + "/tests/fuzz/corpus/usda/two_prims.usda";
  const auto file = read_splats(path, kKeepAxes);
  REQUIRE(file);
  CHECK(file->format == SplatFormat::usda);
  CHECK(file->axes == kAxesUpZ);
  CHECK(file->metres_per_unit == 0.5F);
  CHECK(file->colour_space == ColourSpace::linear_display);
  CHECK(file->aa_mode == AaMode::classic);
  CHECK(file->unused == std::vector<std::string>{"projectionModeHint: tangential"});
  CHECK(file->origin == kNoOrigin);
  const SplatCloud& cloud = file->cloud;
  REQUIRE(cloud.size() == 3);
  REQUIRE(cloud.sh_degree == 1);
  CHECK(cloud.mean == std::vector<float>{6, 22, 36, -1, 12, 50, 1, -2, 4});
  check_near(cloud.log_scale,
             {0, std::log(0.5), std::log(0.25), std::log(2), std::log(4), std::log(8), std::log(2), 0, std::log(0.5)});
  const double r = std::numbers::sqrt2 / 2;
  check_near(cloud.rotation, {0, 0, r, r, r, 0, 0, r, 0, 0, 1, 0});
  check_near(cloud.opacity_logit, {-std::log(3), 9.0107908, 0});
  // A quarter turn about z takes x to y and y to -x; degree 1 is of -y, z and -x.
  check_near(cloud.sh, {0.5,  1,  1.5,  5, 5.5, 6, 3.5,  4,    4.5,  -2, -2.5, -3, -0.5, -1, -1.5, -5, -5.5, -6,
                        -3.5, -4, -4.5, 2, 2.5, 3, 0.25, -0.5, 0.75, 0,  0,    0,  0,    0,  0,    0,  0,    0});
  CHECK(read_splats(path)->cloud.mean == std::vector<float>{6, -36, 22, -1, -50, 12, 1, -4, -2});  // 3DGS's frame
}

TEST_CASE("usda, usdz: round trip: exact to the last places of a float") {
  for (const SplatFormat format : {SplatFormat::usda, SplatFormat::usdz}) {
    for (int degree = 0; degree <= 3; ++degree) {
      for (const std::uint64_t n : {0U, 1U, 500U}) {
        CAPTURE(degree);
        CAPTURE(n);
        const SplatCloud cloud = ordinary_cloud(n, degree, n + 1);
        const Bytes bytes = encode_splats(cloud.view(), format).value();
        CHECK(detect_format(bytes) == format);
        const auto file = read_splats(bytes, kKeepAxes);
        REQUIRE(file);
        CHECK(file->axes == kAxesOpenGl);
        CHECK(file->cloud.sh_degree == (n == 0 ? 0 : degree));
        CHECK(file->unused.empty());
        if (n == 0) continue;
        const SplatError e = compare(file->cloud, cloud);
        CHECK(file->cloud.mean == cloud.mean);
        CHECK(file->cloud.sh == cloud.sh);
        for (const double error : e.log_scale) CHECK(error <= 1e-6);
        CHECK(e.opacity <= 1e-7);
        CHECK(e.rotation <= 1e-6);
      }
    }
  }
}

TEST_CASE("usda: the text is what the schema prescribes") {
  SplatCloud cloud;
  cloud.resize(2, 1);
  Splat s;
  std::ranges::copy(std::array{1.F, -2.5F, 1e-7F}, s.mean);
  std::ranges::copy(std::array{0.F, 0.F, -20.F}, s.log_scale);
  std::ranges::copy(std::array{2.F, 0.F, 0.F, 0.F}, s.rotation);
  s.opacity_logit = 0;
  for (int k = 0; k < 12; ++k) s.sh[k] = 0.1F * static_cast<float>(k);
  cloud.set(0, s);
  s.mean[0] = 3;
  cloud.set(1, s);
  WriteOptions options;
  options.metres_per_unit = 0.01F;
  options.origin = {1e6, 0.1, -2};
  const std::string text = text_of(encode_splats(cloud.view(), SplatFormat::usda, options).value());
  const std::string rgb = "(0, 0.1, 0.2), (0.3, 0.4, 0.5), (0.6, 0.7, 0.8), (0.90000004, 1, 1.1)";
  CHECK(text ==
        "#usda 1.0\n(\n    defaultPrim = \"Splats\"\n    metersPerUnit = 0.01\n    upAxis = \"Y\"\n)\n\n"
        "def ParticleField3DGaussianSplat \"Splats\" (\n    prepend apiSchemas = [\"ColorSpaceAPI\"]\n)\n{\n"
        "    uniform token colorSpace:name = \"srgb_rec709_display\"\n"
        "    float3[] extent = [(-2, -5.5, -3), (6, 0.5, 3)]\n"
        "    point3f[] positions = [(1, -2.5, 1e-07), (3, -2.5, 1e-07)]\n"
        "    quatf[] orientations = [(1, 0, 0, 0), (1, 0, 0, 0)]\n"
        "    float3[] scales = [(1, 1, 2.0611537e-09), (1, 1, 2.0611537e-09)]\n"
        "    float[] opacities = [0.5, 0.5]\n"
        "    uniform int radiance:sphericalHarmonicsDegree = 1\n"
        "    float3[] radiance:sphericalHarmonicsCoefficients = [" +
            rgb + ", " + rgb +
            "] (\n"
            "        elementSize = 4\n        interpolation = \"vertex\"\n    )\n"
            "    uniform token projectionModeHint = \"perspective\"\n    uniform token sortingModeHint = \"zDepth\"\n"
            "    double3 xformOp:translate = (1e+06, 0.1, -2)\n"
            "    uniform token[] xformOpOrder = [\"xformOp:translate\"]\n}\n");
}

TEST_CASE("usda: what the scene declares comes back, in the schema's fields or in customLayerData") {
  const SplatCloud cloud = ordinary_cloud(3, 0, 3);
  WriteOptions options;
  options.aa_mode = AaMode::mip_splatting;
  options.low_pass_px2 = 0.3F;
  options.colour_space = ColourSpace::linear_display;
  options.metres_per_unit = 0.5F;
  auto written = encode_splats(cloud.view(), SplatFormat::usda, options);
  auto file = read_splats(*written);
  CHECK(file->aa_mode == AaMode::mip_splatting);
  CHECK(file->low_pass_px2 == 0.3F);
  CHECK(file->colour_space == ColourSpace::linear_display);
  CHECK(file->metres_per_unit == 0.5F);
  options = {};
  options.aa_mode = AaMode::undeclared;
  options.colour_space = ColourSpace::undeclared;
  options.axes = {Axis::undeclared, Axis::undeclared, Axis::undeclared};
  written = encode_splats(cloud.view(), SplatFormat::usda, options);
  CHECK(text_of(*written).find("metersPerUnit = 1\n") != std::string::npos);  // what other writers say of any scene
  file = read_splats(*written);
  CHECK(file->aa_mode == AaMode::undeclared);
  CHECK(file->colour_space == ColourSpace::undeclared);
  CHECK(file->metres_per_unit == 0);
  CHECK(file->axes == options.axes);
  CHECK(file->cloud.mean == cloud.mean);
  const SplatFile plain = read_text(stage(""));
  CHECK(plain.metres_per_unit == 0.01F);  // UsdGeom's default
  CHECK(plain.axes == kAxesOpenGl);
  CHECK(plain.colour_space == ColourSpace::srgb_display);
  const auto ours = [](const std::string& entries) {
    return "(\n  customLayerData = { dictionary rgs = {" + entries + "} }\n)\n";
  };
  CHECK(read_text(stage("", ours("string anti_aliasing = \"mip-splatting\"; int[] later = [1]"))).aa_mode ==
        AaMode::mip_splatting);
  CHECK(read_text(stage("uniform token colorSpace:name = \"srgb_p3d65_scene\"")).unused ==
        std::vector<std::string>{"a colour space other than Rec. 709"});
  CHECK(read_text(stage("", "", "def Xform \"X\" { uniform token colorSpace:name = \"lin_rec709_scene\"\n % }"))
            .colour_space == ColourSpace::linear_display);
}

TEST_CASE("usda: attributes that are absent or empty have the schema's defaults") {
  const SplatFile file = read_text(stage("quatf[] orientations = None\n float3[] scales\n float[] opacities = []"));
  const Splat s = file.cloud.view().splat(0);
  CHECK(file.cloud.sh_degree == 0);
  CHECK(std::array{s.mean[0], s.mean[1], s.mean[2]} == std::array{1.F, 2.F, 3.F});
  CHECK(std::array{s.rotation[0], s.rotation[1], s.rotation[2], s.rotation[3]} == std::array{1.F, 0.F, 0.F, 0.F});
  CHECK(std::array{s.log_scale[0], s.log_scale[1], s.log_scale[2]} == std::array{0.F, 0.F, 0.F});
  CHECK(opacity_from_logit(s.opacity_logit) >= 0.999F);
  CHECK(std::array{s.sh[0], s.sh[1], s.sh[2]} == std::array{0.F, 0.F, 0.F});
  CHECK(read_text("#usda 1.0\ndef ParticleField3DGaussianSplat \"S\" {}").cloud.size() == 0);
  CHECK(read_text(stage("// a\n/* b { */ int x = 3; /* c */ float[] opacities = [ # d\n 0.5, ]"))
            .cloud.opacity_logit[0] == 0);
  CHECK(read_text(stage("float[] opacities = [nan]\nfloat3[] scales = [(inf, -inf, 1e40)]")).cloud.size() == 1);
}

TEST_CASE("usda: prims move, turn and scale their Gaussians in the order that they state") {
  const glm::dmat3 none(1.0);
  const auto turn = [](double x, double y, double z) { return rotation_from_euler({x, y, z}); };
  const struct {
    const char* ops;
    Similarity expected;
  } cases[] = {
      {"double3 xformOp:translate = (1, 2, 3)\n token[] xformOpOrder = []", {none, 1, {0, 0, 0}}},
      {"double3 xformOp:translate = (1, 2, 3)", {none, 1, {0, 0, 0}}},
      {"double3 xformOp:translate = (1, 2, 3)\n float3 xformOp:scale = (2, 2, 2)\n"
       "uniform token[] xformOpOrder = [\"xformOp:translate\", \"xformOp:scale\"]",
       {none, 2, {1, 2, 3}}},
      {"double3 xformOp:translate = (1, 2, 3)\n float3 xformOp:scale = (2, 2, 2)\n"
       "uniform token[] xformOpOrder = [\"xformOp:scale\", \"xformOp:translate\"]",
       {none, 2, {2, 4, 6}}},
      {"float3 xformOp:rotateXYZ = (10, 20, 30)\n uniform token[] xformOpOrder = [\"xformOp:rotateXYZ\"]",
       {turn(10, 20, 30), 1, {0, 0, 0}}},
      {"float3 xformOp:rotateZYX = (10, 20, 30)\n uniform token[] xformOpOrder = [\"xformOp:rotateZYX\"]",
       {turn(10, 0, 0) * turn(0, 20, 0) * turn(0, 0, 30), 1, {0, 0, 0}}},
      {"float xformOp:rotateY = 40\n uniform token[] xformOpOrder = [\"xformOp:rotateY\"]",
       {turn(0, 40, 0), 1, {0, 0, 0}}},
      {"float xformOp:rotateY:a = 40\n uniform token[] xformOpOrder = [\"!invert!xformOp:rotateY:a\"]",
       {turn(0, -40, 0), 1, {0, 0, 0}}},
      {"quatf xformOp:orient = (2, 0, 0, 2)\n uniform token[] xformOpOrder = [\"xformOp:orient\"]",
       {turn(0, 0, 90), 1, {0, 0, 0}}},
      {"matrix4d xformOp:transform = ((0, 3, 0, 0), (-3, 0, 0, 0), (0, 0, 3, 0), (1, 2, 3, 1))\n"
       "uniform token[] xformOpOrder = [\"xformOp:transform\"]",
       {turn(0, 0, 90), 3, {1, 2, 3}}},
  };
  const SplatCloud cloud = ordinary_cloud(40, 2, 7);
  const std::string text = text_of(encode_splats(cloud.view(), SplatFormat::usda).value());
  const std::string head = text.substr(0, text.find("def ")), prim = text.substr(head.size());
  const std::string outer =
      "double3 xformOp:translate = (5, 0, 0)\n float xformOp:rotateX = 90\n"
      "uniform token[] xformOpOrder = [\"xformOp:translate\", \"xformOp:rotateX\"]\n";
  for (const auto& example : cases) {
    CAPTURE(example.ops);
    SplatCloud expected = cloud;
    transform_splats(expected, example.expected);
    const SplatError own = compare(
        read_text(replaced(text, "    point3f[]", std::string(example.ops) + "\n    point3f[]")).cloud, expected);
    CHECK(own.sum() <= 1e-4);
    // The same in a prim around it, after its children, and in one more around that.
    transform_splats(expected, {turn(90, 0, 0), 1, {5, 0, 0}});
    const SplatError outside = compare(
        read_text(head + "def \"O\" {" + outer + "def Xform \"X\" {\n" + prim + example.ops + "\n}}").cloud, expected);
    CHECK(outside.sum() <= 1e-4);
  }
  const std::string reset =
      "double3 xformOp:translate = (1, 2, 3)\n"
      "uniform token[] xformOpOrder = [\"!resetXformStack!\", \"xformOp:translate\"]";
  SplatCloud moved = cloud;
  transform_splats(moved, {none, 1, {1, 2, 3}});
  CHECK(read_text(head + "def \"O\" {" + outer + "def Xform \"X\" {\n" + prim + reset + "\n}}").cloud.mean ==
        moved.mean);
}

TEST_CASE("usda: a prim's attributes may follow its children, also those with Gaussians") {
  const SplatFile file = read_text(stage(stage("float[] opacities = [0.25]").substr(10) + "float[] opacities = [0.5]"));
  REQUIRE(file.cloud.size() == 2);
  CHECK(file.cloud.opacity_logit[0] == 0);
  CHECK(file.cloud.opacity_logit[1] < -1);
}

TEST_CASE("usda: far prims get one origin in the middle of theirs, and the rounding is stated") {
  const auto at = [](const std::string& where) {
    return "double3 xformOp:translate = " + where + "\n uniform token[] xformOpOrder = [\"xformOp:translate\"]";
  };
  const SplatFile one = read_text(stage(at("(500000.25, 0, -4e6)")));
  CHECK(one.origin == Origin{500000.25, 0, -4e6});
  CHECK(one.cloud.mean == std::vector<float>{1, 2, 3});
  const std::string other = stage(at("(500002.25, 0, -4e6)"));
  const SplatFile both = read_text(stage(at("(500000.25, 0, -4e6)"), "", "%" + other.substr(other.find("def"))));
  CHECK(both.origin == Origin{500001.25, 0, -4e6});
  CHECK(both.cloud.mean == std::vector<float>{0, 2, 3, 2, 2, 3});
  CHECK(both.position_rounding == 0);
  const SplatCloud cloud = ordinary_cloud(30, 1, 5);
  const Origin origin{450000.1, 5000000, -30};
  const auto file = read_splats(encode_splats(cloud.view(), SplatFormat::usdz, {.origin = origin}).value(), kKeepAxes);
  CHECK(file->origin == origin);
  CHECK(file->cloud.mean == cloud.mean);
}

TEST_CASE("usda: what is not shown or not followed is named") {
  const std::string hidden = "def Xform \"X\" { token visibility = \"invisible\"\n%}\n" + stage("").substr(10);
  const SplatFile file = read_text(stage("", "", hidden));
  CHECK(file.cloud.size() == 1);
  CHECK(file.unused == std::vector<std::string>{"invisible Gaussians"});
  const SplatFile more =
      read_text(stage("", "", "def \"X\" (\n prepend references = @a.usdc@</A> (scale = 2)\n) {}\n%"));
  CHECK(more.unused == std::vector<std::string>{"references, payloads or variants"});
  CHECK(read_text(stage("token visibility.timeSamples = { 0: \"invisible\" }", "",
                        "def \"X\" { token visibility.timeSamples = { 0: \"invisible\" } }\n%"))
            .unused == std::vector<std::string>{"visibility that varies in time"});
  CHECK(
      read_text(stage("", "", "def \"X\" { token visibility.timeSamples = { 0: \"invisible\" } }\n%")).unused.empty());
  const auto around = [](const std::string& head) { return stage("", "", head + "\n%}\n" + stage("").substr(10)); };
  const SplatFile instanced = read_text(around("def PointInstancer \"X\" {"));
  CHECK(instanced.cloud.size() == 1);
  CHECK(instanced.unused == std::vector<std::string>{"Gaussians below a PointInstancer"});
  for (const std::string purpose : {"guide", "proxy"}) {
    const SplatFile left = read_text(around("def \"X\" { uniform token purpose = \"" + purpose + "\""));
    CHECK(left.cloud.size() == 1);
    CHECK(left.unused == std::vector<std::string>{"Gaussians of purpose guide or proxy"});
    CHECK(read_text(stage("uniform token purpose = \"render\"", "",
                          "def \"X\" { uniform token purpose = \"" + purpose + "\"\n%}\n"))
              .unused.empty());
  }
  CHECK(read_text(around("def \"X\" { uniform token purpose = \"render\"")).cloud.size() == 2);
  for (const char* without : {"def \"X\" ( active = false ) {%}\n", "class \"X\" {%}\n", "over \"X\" {%}\n"}) {
    CAPTURE(without);
    CHECK(read_text(stage("", "", without + stage("").substr(10))).cloud.size() == 1);
  }
}

TEST_CASE("usda: unsupported or invalid text is refused at its byte, which ^ marks") {
  const auto with_op = [](const std::string& name, const std::string& value) {
    return stage("double3 ^" + name + " = " + value + "\n uniform token[] xformOpOrder = [\"" + name + "\"]");
  };
  const std::pair<std::string, Errc> cases[] = {
      {"#usda ^2.0\n", Errc::unsupported_version},
      {"^#usda 1.0\ndef Xform \"X\" {}\n", Errc::not_gaussian_splats},
      {"#usda 1.0\ndef Xform \"X\" {^", Errc::truncated},
      {"#usda 1.0\n^12", Errc::bad_syntax},
      {stage("") + "^" + std::string(1, '\0') + stage("").substr(10), Errc::bad_syntax},
      {"#usda 1.0\ndef \"X\" ^[]", Errc::bad_syntax},
      {"#usda 1.0\ndef ^\"X", Errc::truncated},
      {"#usda 1.0\n^/* def", Errc::truncated},
      {"#usda 1.0\ndef \"X\" { asset a = ^@b }", Errc::truncated},
      {"#usda 1.0\ndef \"X\" { int[] a = [(1, 2^] }", Errc::bad_syntax},
      {"#usda 1.0\ndef \"X\" { int ^= 3 }", Errc::bad_syntax},
      {stage("", "(\n  ^upAxis = \"X\"\n)\n"), Errc::bad_value},
      {stage("", "(\n  ^metersPerUnit = 0\n)\n"), Errc::bad_value},
      {stage("", "(\n  ^metersPerUnit = inf\n)\n"), Errc::bad_value},
      {stage("", "(\n  metersPerUnit = ^\"one\"\n)\n"), Errc::bad_syntax},
      {stage("", "(\n  ^subLayers = [@a.usda@]\n)\n"), Errc::unsupported_feature},
      {stage("", "(\n  customLayerData = { dictionary rgs = ^{ string axes = \"up\" } }\n)\n"), Errc::bad_value},
      {stage("", "", "def \"X\" (\n  ^payload = @a.usdc@\n) {%}"), Errc::unsupported_feature},
      {stage("", "", "def \"X\" (\n  ^add variantSets = \"lod\"\n) { def \"Y\" {%} }"), Errc::unsupported_feature},
      {"#usda 1.0\nover \"X\" (\n  ^references = @gaussians.usdc@\n) {}\n", Errc::unsupported_feature},
      {"#usda 1.0\ndef ^ParticleField \"S\" {}\n", Errc::unsupported_feature},
      {stage("quatf[] ^orientations = [(1, 0, 0, 0), (1, 0, 0, 0)]"), Errc::size_mismatch},
      {stage("float3[] ^radiance:sphericalHarmonicsCoefficients = [(1, 0, 0)]"), Errc::size_mismatch},  // of degree 3
      {"#usda 1.0\ndef ParticleField3DGaussianSplat \"S\" { float3[] scales = [(1, 0, 0)^", Errc::truncated},
      {stage("float3[] scales = [(1, 0^)]"), Errc::bad_syntax},
      {stage("float3[] scales = [(1, 0, ^x)]"), Errc::bad_syntax},
      {stage("float3[] scales = [(1, 0, ^1-2)]"), Errc::bad_syntax},
      {stage("float3[] scales = [(1, 0, 1) ^(1, 0, 1)]"), Errc::bad_syntax},
      {stage("float3[] scales = ^(1, 0, 1)"), Errc::bad_syntax},
      {stage("point3f[] ^positions = [(1, 2, 3)]"), Errc::bad_syntax},
      {stage("double3[] ^scales = [(1, 0, 1)]"), Errc::unsupported_feature},
      {stage("float3 ^scales = (1, 0, 1)"), Errc::unsupported_feature},
      {stage("float3[] ^scales.timeSamples = { 0: [(1, 0, 1)] }"), Errc::unsupported_feature},
      {stage("float[] ^opacitiesh.connect = </A.b>"), Errc::unsupported_feature},
      {stage("uniform int ^radiance:sphericalHarmonicsDegree = 4"), Errc::unsupported_feature},
      {stage("uniform int ^radiance:sphericalHarmonicsDegree = -1"), Errc::bad_value},
      {with_op("xformOp:translate", "(1, 2)"), Errc::unsupported_feature},
      {with_op("xformOp:rotateXX", "(1, 2, 3)"), Errc::unsupported_feature},
      {with_op("xformOp:rotateX", "(1, 2, 3)"), Errc::unsupported_feature},
      {with_op("xformOp:spin", "3"), Errc::unsupported_feature},
      {with_op("xformOp:orient", "(0, 0, 0, 0)"), Errc::unsupported_feature},
      {with_op("xformOp:translate", "(1, 2, inf)"), Errc::bad_value},
      {stage("double3 ^xformOp:translate.timeSamples = { 0: (1, 2, 3) }\n"
             "uniform token[] xformOpOrder = [\"xformOp:translate\"]"),
       Errc::unsupported_feature},
      {stage("double3 ^xformOp:translate.timeSamples = { 0: (1, 2, 3) }\ndouble3 xformOp:translate = (1, 2, 3)\n"
             "uniform token[] xformOpOrder = [\"xformOp:translate\"]"),
       Errc::unsupported_feature},
      {stage("matrix4d xformOp:transform = ((^(1, 0, 0, 0)))"), Errc::bad_syntax},
      {stage("uniform token[] ^xformOpOrder = [\"xformOp:translate\"]"), Errc::bad_value},
      {"#usda 1.0\ndef ^ParticleField3DGaussianSplat \"S\" { float3 xformOp:scale = (1, 1, -1)\n"
       "uniform token[] xformOpOrder = [\"xformOp:scale\"] }",
       Errc::unsupported_feature},
      {"#usda 1.0\ndef ^ParticleField3DGaussianSplat \"S\" { float3 xformOp:scale = (1, 2, 1)\n"
       "uniform token[] xformOpOrder = [\"xformOp:scale\"] }",
       Errc::unsupported_feature},
  };
  for (const auto& [marked, code] : cases) {
    const std::string text = replaced(marked, "^", "");
    const Errc expected = code;
    CAPTURE(text);
    const auto file = read_exact(bytes_of(text));
    REQUIRE_FALSE(file);
    CHECK(std::string(errc_name(file.error().code)) == errc_name(expected));
    CHECK(file.error().offset == marked.find('^'));
  }
  DecodeLimits limits;
  limits.max_gaussians = 1;
  const std::string two = stage("", "", "%" + stage("").substr(10));
  CHECK(read_splats(bytes_of(two), {.limits = limits}).error().code == Errc::limit_exceeded);
}

TEST_CASE("usda: prims and brackets are nested at most 64 deep") {
  const auto prims = [](int n) {
    std::string text = "%";
    for (int i = 0; i < n; ++i) text = "def \"X\" {" + text + "}";
    return text;
  };
  CHECK(read_text(stage("", "", prims(64))).cloud.size() == 1);
  CHECK(read_exact(bytes_of(stage("", "", prims(65)))).error().code == Errc::bad_syntax);
  const auto brackets = [](int n) {
    return stage("int x = " + std::string(static_cast<std::size_t>(n), '(') + "1" +
                 std::string(static_cast<std::size_t>(n), ')'));
  };
  CHECK(read_text(brackets(64)).cloud.size() == 1);
  CHECK(read_exact(bytes_of(brackets(65))).error().code == Errc::bad_syntax);
}

TEST_CASE("usdz: one stored .usda at a multiple of 64 bytes; other packages by their first file") {
  const SplatCloud cloud = ordinary_cloud(7, 1, 2);
  const Bytes layer = encode_splats(cloud.view(), SplatFormat::usda).value(),
              bytes = encode_splats(cloud.view(), SplatFormat::usdz).value();
  CHECK(text_of(bytes).substr(0, 4) == "PK\3\4");
  CHECK(get<std::uint16_t>(bytes, 8) == 0);  // stored
  CHECK(get<std::uint32_t>(bytes, 22) == layer.size());
  const std::size_t begin = 30U + get<std::uint16_t>(bytes, 26) + get<std::uint16_t>(bytes, 28);
  CHECK(begin % 64 == 0);
  CHECK(text_of(bytes).substr(30, 10) == "scene.usda");
  CHECK(text_of(bytes).substr(begin, layer.size()) == text_of(layer));
  const auto read = [](const Files& files) { return read_splats(zipped(files)); };
  CHECK(read({{"a.usda", layer}, {"b.usdc", bytes_of("PXR-USDC")}})->cloud.size() == 7);
  CHECK(read({{"a.usd", layer}, {"b.png", {}}})->format == SplatFormat::usdz);
  CHECK(read({{"a.usdc", bytes_of("PXR-USDC")}, {"b.usda", layer}}).error().code == Errc::unsupported_feature);
  CHECK(std::string(read({{"a.usdc", bytes_of("PXR-USDC")}}).error().what).find("usdcat -o") != std::string::npos);
  CHECK(read({{"a.usda", bytes_of("text")}}).error().code == Errc::bad_magic);
  CHECK(read({{"a.usda", bytes_of("#usda 1.0\n^")}}).error().offset == 10);
}

TEST_CASE("usdz: prims without Gaussians count as what a small package expands to") {
  std::string text = "#usda 1.0\n";
  for (int i = 0; i < 10'000; ++i) text += "def ParticleField3DGaussianSplat \"\" {}\n";
  CHECK(read_splats(bytes_of(text))->cloud.size() == 0);
  CHECK(read_splats(zipped({{"a.usda", bytes_of(text)}})).error().code == Errc::limit_exceeded);
}

TEST_CASE("growth: usda: reading is linear in prims, transforms and texts that are skipped") {
  const auto repeated = [](const std::string& text, std::uint64_t n) {
    std::string all;
    for (std::uint64_t i = 0; i < n; ++i) all += replaced(text, "%", std::to_string(i));
    return all;
  };
  const auto read = [](const Bytes& file) { CHECK(read_splats(file)); };
  const std::string prim = stage("").substr(10);
  CHECK(growth(
            1000,
            [&](std::uint64_t n) { return bytes_of(stage("", "", "%" + repeated(replaced(prim, "S", "S%"), n))); },
            read) < kLinearGrowth);
  CHECK(growth(
            1000,
            [&](std::uint64_t n) {
              return bytes_of(stage(repeated("double xformOp:rotateX:a% = 0\n", n) +
                                    "uniform token[] xformOpOrder = [" + repeated("\"xformOp:rotateX:a%\",", n) + "]"));
            },
            read) < kLinearGrowth);
  CHECK(growth(
            1000, [&](std::uint64_t n) { return bytes_of(stage(repeated("string a% = \"\"\"x\"\"\" # y\n", n))); },
            read) < kLinearGrowth);
}

TEST_CASE("damaged usda and usdz files are refused or read, but never crash") {
  Bytes text = encode_splats(ordinary_cloud(3, 1, 3).view(), SplatFormat::usda,
                             {.aa_mode = AaMode::mip_splatting, .origin = {1e6, 0, 0}})
                   .value();
  text.pop_back();  // the line's end, without which the text is whole
  check_hostile(text, 8, 1500);
  check_hostile(encode_splats(ordinary_cloud(2, 0, 3).view(), SplatFormat::usdz).value(), 9, 1000);
}
