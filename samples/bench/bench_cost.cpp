// bench_cost.cpp - bytes and operations of each stage.
// SPDX-License-Identifier: Apache-2.0
#include "bench_cost.hpp"

#include <algorithm>

#include "common/frame.hpp"
#include "rgs/ablation.hpp"
#include "rgs/math/coverage.hpp"
#include "turbo/turbo.hpp"

namespace rgs::bench {
namespace {

// ---- sizes -----------------------------------------------------------------------------------------------------

constexpr double kWord = 4;
constexpr double kMeanBytes = 3 * kWord;                    // FP32 in both forms
constexpr double kFp32GeometryBytes = (4 + 3 + 1) * kWord;  // rotation, scale, opacity
constexpr double kCompactGeometryBytes = 8 * 2;             // the same in FP16
constexpr double kSectorBytes = 32;                         // the least that a lone load moves
constexpr double kSplatBytes = sizeof(cuda::ScreenSplat);
constexpr double kRangeBytes = sizeof(cuda::TileRange);
constexpr double kTilePixels = math::kTileSize * math::kTileSize;
constexpr double kWarp = 32;

constexpr double sh_bytes(bool compact, int degree) {
  const int codes = 3 * (degree + 1) * (degree + 1), words = compact ? (codes + 3) / 4 : codes;
  return words * kWord;
}

// What the separate front end keeps between its kernels: the rectangle, or the ellipse and its rows.
constexpr double cover_bytes(math::Extent extent) {
  return extent == math::Extent::square ? sizeof(math::TileRect) : sizeof(math::Ellipse<float>) + 2 * sizeof(int);
}

// ---- operations ------------------------------------------------------------------------------------------------

// Counted in the source, function by function; loads, addresses, conversions, branches and loop counters are left out.
struct Ops {
  double flops = 0, operations = 0, special = 0;
};
constexpr Ops operator+(const Ops& a, const Ops& b) {
  return {a.flops + b.flops, a.operations + b.operations, a.special + b.special};
}

// The front end is compiled without contraction: every flop is an operation. A division and a root have one special
// operation each, and count as one flop.
constexpr Ops uncontracted(double flops, double special) {
  return {flops, flops, special};
}
constexpr Ops kToCamera = uncontracted(21, 0);   // from_camera(): 6 sub; 3 x (3 mul, 2 add)
constexpr Ops kToPixel = uncontracted(8, 2);     // 2 x (mul, div, add, sub)
constexpr Ops kRotation = uncontracted(39, 0);   // rotation_matrix(): 3 x 5 on the diagonal, 6 x 4 beside it
constexpr Ops kCovariance = uncontracted(78, 1)  // project_covariance(): 1/z; 2 slopes of mul, min, max; jx, jy;
                            + kRotation;         // du, dv: 2 x 9; M: 6 x (dot 5, mul); cov: 3 dots
constexpr Ops kFootprint = uncontracted(9, 1);   // footprint(): low-pass 2, det 3, 1/det, conic 3
constexpr Ops kCutoff{26, 21, 1};                // power_cutoff(): div; logf() of the CUDA library has 11 FMA
constexpr Ops kProject = kToPixel + kCovariance + kFootprint + kCutoff;

// square_extent(): mid 2, lambda 5 with one root, radius 3 with one root, four sides 12 and their clamps 8.
constexpr Ops kSquare = uncontracted(30, 2);
// ellipse(): det 3, rounding 3, level 4, half axes 4, slope, shear 3, variance; bounding_tiles(): 20.
constexpr Ops kEllipse = uncontracted(39, 7);
// tiles_in_row(): row's ends 4; chord(): clamps 4, levels 8, ends 8; slack 6; tiles_between(): 10.
constexpr Ops kEllipseRow = uncontracted(40, 4);

constexpr Ops color_ops(int degree, bool compact) {
  constexpr double kBasis[] = {0, 3, 3 + 15, 3 + 15 + 30};  // sh_basis(): products and sums by degree, from above
  const double codes = 3.0 * (degree + 1) * (degree + 1);
  const double direction = degree > 0 ? 10 : 0;  // view_direction(): dot 5, root, div, 3 mul; to_camera()'s difference
  // sh_color(): mul and add each; + 1/2 and clamp of three channels. dequantize_sh(): one product.
  return uncontracted(direction + kBasis[degree] + (compact ? 3 : 2) * codes + 6, degree > 0 ? 2 : 0);
}

// Blending is compiled with contraction. A pair that is evaluated ends at the test of its opacity or exponent; one that
// is blended goes on.
struct PairOps {
  Ops evaluated, blended;
};

// expf() of the CUDA library: 4 FMA, addition, shift, ex2, product. exp2f(): ex2 and a test with two products around it
// that small exponents alone need.
constexpr Ops kExp{10, 8, 1}, kExp2{0, 4, 1};
// exp2_bits(): FMA and a conversion, which the special function units make; the shift of negative_exp2() instead.
constexpr Ops kExpBits{2, 2, 1}, kExpShift{0, 1, 0};
// blend(): 1 - alpha, times T; test; weight; three FMA.
constexpr Ops kBlend{2 + 1 + 6, 2 + 1 + 1 + 3, 0};
constexpr Ops kClamp{0, 1, 0}, kTest{0, 1, 0}, kMultiply{1, 1, 0};

constexpr PairOps direct_ops(math::Exp exp) {
  // Two differences; power(): 5 mul, 2 FMA; its sign is tested.
  constexpr Ops kPower = Ops{2 + 5 + 4, 2 + 5 + 2, 0} + kTest;
  if (exp == math::Exp::exact) return {kPower + kExp + kMultiply + kClamp + kTest, kBlend};
  return {kPower + kTest, kMultiply + kExpBits + kMultiply + kClamp + kBlend};
}

constexpr PairOps folded_ops(math::Exp exp, int pixels) {
  // folded_exponent(): 5 FMA. folded_exponent_below(): 2 FMA and an addition, 2 y + 1 being the thread's constant.
  const Ops exponent = pixels == 2 ? Ops{(10 + 5) / 2.0, (5 + 3) / 2.0, 0} : Ops{10, 5, 0};
  if (exp == math::Exp::exact) return {exponent + kTest, kExp2 + kClamp + kBlend};
  if (pixels == 1) return {exponent + kTest, kClamp + kExpBits + kClamp + kBlend};
  // The paper's loop tests the larger exponent of its two pixels: (max, test) / 2. Then a pixel: clamp, shift, test,
  // select; next as one FMA, test; weight and its select; three FMA; select of the transmittance.
  return {exponent + Ops{0, 1, 0}, kClamp + kExpShift + Ops{2 + 1 + 6, 2 + 2 + 2 + 3 + 1, 0}};
}

// Bytes of shared memory that a warp reads for a Gaussian: mean 2, conic 3, opacity, or the six folded coefficients;
// and the colour where it is blended.
constexpr double kSharedBytes = 6 * kWord, kSharedColorBytes = 3 * kWord;

// Turbo blends a cell without a branch: what is evaluated takes all operations, unless matrix products leave it out.
constexpr double kTurboCellPixels = cuda::kTurboCellWidth * cuda::kTurboCellHeight;

// In FP32: a thread's column of pixels has 3 FMA in x, then a pixel 2 FMA; ex2; test and select; weight, difference,
// three FMA. The clamp is for rare Gaussians and not counted.
constexpr double kTurboColumn = kTurboCellPixels / 32;
constexpr Ops kTurboOps{2 * (3 / kTurboColumn + 2) + 1 + 1 + 6, 3 / kTurboColumn + 2 + 1 + 2 + 1 + 1 + 3, 1};
constexpr double kTurboSharedBytes = 2 * 16;  // six coefficients, colour in FP16

// By matrix products, whose exponents and colours are not counted: they have units of their own, which are busy for a
// shorter time than those of the exponentials (docs/records/MEASUREMENTS.md, "Roofline"). A lane has 16 (pixel,
// Gaussian) pairs of 16 pixels and 32 Gaussians, two in an instruction but for the exponential: eight times conversion
// to FP16, opacity, weight and what it lets through, but the first of a chain has its weight already; eight products
// with the chain's transmittance; seven products and two selections over the chains.
constexpr double kLanePairs = 16;
constexpr Ops kTensorOps{(2 * (8 * (1 + 1 + 2 + 1) - 2) + 2 * 7) / kLanePairs,
                         (8 * (1 + 1 + 1 + 1 + 1) - 2 + 7 + 2) / kLanePairs + 1, 1};
// For 32 pixels and 32 Gaussians a warp reads coefficients, twice, and colours.
constexpr double kTensorLoads = 3, kTensorLoadPairs = 2 * 16 * 32;

void add(Cost& cost, const Ops& ops, double times) {
  cost.flops += ops.flops * times;
  cost.operations += ops.operations * times;
  cost.special += ops.special * times;
}

// ---- stages ----------------------------------------------------------------------------------------------------

// The counts as floating point, and what a pair takes.
struct Counts {
  double gaussians, visible, pairs, evaluated, blended, tiles, pixels, pixel_bytes, key_bytes;
  explicit Counts(const FrameWork& w)
      : gaussians(static_cast<double>(w.stats.gaussians)),
        visible(static_cast<double>(w.stats.visible)),
        pairs(static_cast<double>(w.stats.instances)),
        evaluated(static_cast<double>(w.stats.evaluated)),
        blended(static_cast<double>(w.stats.blended)),
        tiles(static_cast<double>(math::tile_grid(w.width, w.height).columns) *
              static_cast<double>(math::tile_grid(w.width, w.height).rows)),
        pixels(static_cast<double>(w.width) * static_cast<double>(w.height)),
        pixel_bytes(static_cast<double>(w.pixel_bytes)),
        key_bytes(w.stats.key_bits <= 32 ? 4 : 8) {}
  double pair_bytes() const { return key_bytes + kWord; }
};

// Means of all Gaussians; geometry, harmonics and the result of the visible ones. (Those in the depth range but beside
// the image have their geometry read as well, and each chunk its scales: neither is counted.)
Cost project_cost(const FrameWork& w, const Counts& n) {
  Cost c;
  const double geometry = w.compact ? kCompactGeometryBytes : kFp32GeometryBytes;
  c.bytes = n.gaussians * kMeanBytes + n.visible * (geometry + sh_bytes(w.compact, w.sh_degree) + kSplatBytes);
  add(c, kToCamera, n.gaussians);
  const PaperSteps steps = steps_of(w.options, Backend::cuda);
  const bool square = steps.extent == math::Extent::square;
  add(c, kProject + (square ? kSquare : kEllipse), n.visible);
  add(c, color_ops(std::min(w.sh_degree, w.options.sh_degree_limit), w.compact), n.visible);
  if (!square) add(c, kEllipseRow, n.visible);  // one row each at least
  if (steps.front_end == PaperSteps::FrontEnd::fused) {
    if (!square) add(c, kEllipseRow, n.visible);  // and once more to emit
    c.bytes += n.pairs * n.pair_bytes();
  } else {
    c.bytes += n.gaussians * kWord + n.visible * cover_bytes(steps.extent);  // tile counts, covers
  }
  return c;
}

// Chunks outside the view are not read, so that nobody but the visible ones is sure to be. Splats lie at the Gaussians' indices.
// Runs of entries are not counted: they are few.
Cost turbo_project_cost(const FrameWork& w, const Counts& n) {
  Cost c;
  const double geometry = w.compact ? kCompactGeometryBytes : kFp32GeometryBytes;
  c.bytes = (w.compact ? n.visible : n.gaussians) * kMeanBytes +
            n.visible * (geometry + sh_bytes(w.compact, w.sh_degree) + kSplatBytes) +
            n.pairs * sizeof(cuda::TurboEntry);
  add(c, kToCamera + kProject + kEllipse + kEllipseRow + kEllipseRow, n.visible);
  add(c, color_ops(std::min(w.sh_degree, w.options.sh_degree_limit), w.compact), n.visible);
  return c;
}

double turbo_tiles(const FrameWork& w) {
  const auto grid = math::tile_grid<cuda::kTurboTile>(w.width, w.height);
  return static_cast<double>(grid.columns) * static_cast<double>(grid.rows);
}

// Counts of entries and runs to a list, tile by tile, and the list to its rank. Runs are not counted; the cells of empty tiles,
// which are written here, are counted with the others'.
Cost turbo_bin_cost(const FrameWork& w) {
  Cost c;
  c.bytes = turbo_tiles(w) * (sizeof(cuda::TurboCount) + 2 * sizeof(cuda::TurboList) + sizeof(cuda::TurboRankedList));
  return c;
}

// Gaussians that cells go through: one serves the pixels of its cell at most.
double staged_by_cells(const Counts& n) {
  return n.evaluated / kTurboCellPixels;
}

// Every entry is read, once if its list is short, and written to one cell at least; cells have all that their pixels go
// through. Ranks of Gaussians are read where depths are equal alone, and not counted; nor are integer operations, which
// ordering takes.
Cost turbo_order_cost(const FrameWork& w, const Counts& n) {
  Cost c;
  c.bytes = n.pairs * sizeof(cuda::TurboEntry) + std::max(n.pairs, staged_by_cells(n)) * kWord +
            turbo_tiles(w) * (sizeof(cuda::TurboRankedList) + cuda::kTurboCells * sizeof(cuda::TurboCell));
  return c;
}

// Evaluated pairs are those of the definition, whose pixels stop at kTransmittanceMin. Matrix products stop at a
// higher one, though only with all pixels of a warp, and leave out what does not touch them in long lists: their floor
// may be too high by that.
Cost turbo_blend_cost(const FrameWork& w, const Counts& n) {
  Cost c;
  const double staged = staged_by_cells(n);
  c.bytes = std::min(n.visible, staged) * kSplatBytes + staged * kWord +
            turbo_tiles(w) * cuda::kTurboCells * sizeof(cuda::TurboCell) + n.pixels * n.pixel_bytes;
  c.l2_bytes = staged * (kSplatBytes + kWord);
  if (w.options.turbo.tensor_cores) {
    c.shared_loads = n.evaluated / kTensorLoadPairs * kTensorLoads;
    add(c, kTensorOps, n.evaluated);
  } else {
    c.shared_loads = staged * (kTurboCellPixels / kTurboColumn / kWarp) * kTurboSharedBytes / 16;
    add(c, kTurboOps, n.evaluated);
  }
  return c;
}

// Tile ranges; before them, of the separate front end, the sum over tile counts and the duplication.
Cost bin_cost(const FrameWork& w, const Counts& n) {
  Cost c;
  c.bytes = n.pairs * n.key_bytes + 2 * n.tiles * kRangeBytes;  // cleared, then written
  const PaperSteps steps = steps_of(w.options, Backend::cuda);
  if (steps.front_end == PaperSteps::FrontEnd::separate) {
    c.bytes += n.gaussians * (kWord + 8) + n.gaussians * 8;  // counts to 64-bit sums; sums
    c.bytes += n.visible * (cover_bytes(steps.extent) + kSectorBytes) + n.pairs * n.pair_bytes();  // cover, z
  }
  return c;
}

// One-sweep radix sort: a reading of the keys for all histograms, then every pass of 8 bits reads and writes each pair.
Cost sort_cost(const FrameWork& w, const Counts& n) {
  Cost c;
  const int passes = (w.stats.key_bits + 7) / 8;
  c.bytes = n.pairs * (n.key_bytes + 2 * passes * n.pair_bytes());
  return c;
}

// A staged Gaussian serves the pixels of one tile at most, so that at least evaluated / 256 are staged: that many
// indices from memory and splats from L2. Memory sees each visible splat once.
Cost blend_cost(const FrameWork& w, const Counts& n) {
  Cost c;
  const double staged = n.evaluated / kTilePixels;
  c.bytes =
      std::min(n.visible, staged) * kSplatBytes + staged * kWord + n.tiles * kRangeBytes + n.pixels * n.pixel_bytes;
  c.l2_bytes = staged * (kSplatBytes + kWord);
  const PaperSteps steps = steps_of(w.options, Backend::cuda);
  const int pixels = steps.pixels_per_thread;
  const PairOps ops = steps.exponent == math::Exponent::direct ? direct_ops(steps.exp) : folded_ops(steps.exp, pixels);
  add(c, ops.evaluated, n.evaluated);
  add(c, ops.blended, n.blended);
  const double pixels_a_load = kWarp * pixels;
  c.shared_loads = (n.evaluated * kSharedBytes + n.blended * kSharedColorBytes) / pixels_a_load / 16;
  return c;
}

}  // namespace

const char* stage_name(Stage stage) {
  switch (stage) {
    case Stage::project: return "project";
    case Stage::bin: return "bin";
    case Stage::sort: return "sort";
    case Stage::blend: return "blend";
  }
  return "";
}

double stage_ms(const FrameStats& s, Stage stage) {
  switch (stage) {
    case Stage::project: return s.project_ms;
    case Stage::bin: return s.bin_ms;
    case Stage::sort: return s.sort_ms;
    case Stage::blend: return s.blend_ms;
  }
  return 0;
}

Cost& Cost::operator+=(const Cost& other) {
  bytes += other.bytes, l2_bytes += other.l2_bytes, flops += other.flops;
  operations += other.operations, special += other.special, shared_loads += other.shared_loads;
  return *this;
}

StageCosts stage_costs(const FrameWork& work) {
  const Counts n(work);
  if (work.options.pipeline == Pipeline::turbo) {
    return {turbo_project_cost(work, n), turbo_bin_cost(work), turbo_order_cost(work, n), turbo_blend_cost(work, n)};
  }
  return {project_cost(work, n), bin_cost(work, n), sort_cost(work, n), blend_cost(work, n)};
}

Cost sum(const StageCosts& costs) {
  Cost total;
  for (const Cost& cost : costs) total += cost;
  return total;
}

Floor floor_of(const Cost& cost, const cuda::DeviceRates& rates) {
  const Floor demands[] = {
      {1e3 * cost.bytes / rates.copy_bytes, "memory"},
      {1e3 * cost.l2_bytes / rates.l2_bytes, "L2"},
      {1e3 * cost.operations / rates.fp32, "FP32"},
      {1e3 * cost.special / rates.special, "special"},
      {1e3 * cost.shared_loads / rates.shared_loads, "shared"},
  };
  return *std::max_element(std::begin(demands), std::end(demands),
                           [](const Floor& a, const Floor& b) { return a.ms < b.ms; });
}

}  // namespace rgs::bench
