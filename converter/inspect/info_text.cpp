// info_text.cpp - the report of rgs-info for people.
// SPDX-License-Identifier: Apache-2.0
#include "info_text.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <numbers>
#include <string_view>

#include "console.hpp"
#include "info_escape.hpp"
#include "rgs/quantize.hpp"
#include "text_lines.hpp"

namespace rgs::tool {
namespace {

constexpr const char* kChannels[3] = {"red", "green", "blue"};

class TextReport : private TextLines {
 public:
  TextReport(const InfoReport& report, bool ascii)
      : report_(report),
        view_(*report.view),
        scene_(report.leaves ? *report.leaves : view_),
        header_(view_.header()),
        ascii_(ascii) {}

  std::string file() {
    title("");
    summary();
    declarations();
    sections();
    if (report_.paged) levels();
    if (view_.archive() != nullptr) archive(*view_.archive());
    if (report_.steps) steps();
    if (report_.chunks) chunks();
    values();
    return take();
  }

  std::string chunk() {
    const ChunkReport& c = *report_.chunk;
    title(fmt::format(", chunk {} of {}", format_count(c.index), format_count(header_.n_chunks)));
    row("Gaussians", fmt::format("{} from {} on", format_count(c.entry.count), format_count(c.first)));
    box("box", c.entry.means);
    row("radius", fmt::format("{:.4g} (3 sigma of the largest scale)", c.entry.radius));
    row("largest opacity", fmt::format("{:.4g}", c.entry.max_opacity));
    line("");
    line("{:<6}{:>16}{:>14}{:>10}", "bytes", "offset", "stored", report_.paged ? "page" : view_.coded() ? "frame" : "");
    if (report_.paged) {
      page_of_chunk(c);
    } else {
      rows_of_chunk(c);
    }
    step_table(fmt::format("SH steps, set {}", format_count(c.entry.step_set)), c.steps);
    values();
    return take();
  }

  std::string page() {
    const PagedFile& file = *report_.paged;
    const auto i = static_cast<std::uint32_t>(*report_.page_asked);
    const lod::Page& p = file.pages()[i];
    const StoredPage& stored = file.stored(i);
    title(fmt::format(", page {} of {}", format_count(i), format_count(file.n_pages())));
    row("level", p.level == 0 ? "0, finest" : std::to_string(p.level));
    row("Gaussians", format_count(p.count));
    row("parent", p.parent == lod::kNoPage ? "none, the root" : format_count(p.parent));
    if (p.n_children != 0) row("children", fmt::format("{} from {} on", p.n_children, format_count(p.first_child)));
    row("error", fmt::format("{:.6g} world units a pixel", p.error));
    box("box, 3 sigma", p.bounds);
    box("core", p.core);
    row("stored", fmt::format("{} bytes from {} on, xxh3 {:016x}{}", format_count(stored.stored_bytes),
                              format_count(stored.offset), stored.xxh3, i < file.n_present() ? "" : "; MISSING"));
    row("decoded",
        fmt::format("{} bytes; {} set{} of SH steps, scales times 2^{}", format_count(file.decoded_bytes(i)),
                    format_count(stored.n_step_sets), stored.n_step_sets == 1 ? "" : "s", stored.scale_exponent));
    return take();
  }

 private:
  void row(std::string_view key, std::string_view value) { line("  {:<17}{}", key, value); }

  void title(const std::string& what) {
    line("{}{}: RoofGS {}.{}, {} Gaussians, SH degree {}", escape_untrusted(report_.path, ascii_, 4096), what,
         header_.version_major, header_.version_minor, format_count(header_.n_gaussians), header_.sh_degree);
  }

  void summary() {
    const std::uint64_t ply = ply_bytes(header_);
    std::string size = fmt::format("{} bytes ({})", format_count(report_.file_bytes), format_bytes(report_.file_bytes));
    if (header_.n_gaussians != 0) {
      size += fmt::format(", {:.2f} a Gaussian; as PLY {} ({} a Gaussian): {:.2f}x",
                          bytes_per_gaussian(report_.file_bytes, header_), format_bytes(ply), ply / header_.n_gaussians,
                          static_cast<double>(ply) / static_cast<double>(report_.file_bytes));
    }
    row("size", size);
    const std::uint64_t full = header_.n_gaussians / std::max(header_.chunk_size, 1u);
    const std::uint64_t rest = header_.n_gaussians - full * header_.chunk_size;
    row("chunks",
        fmt::format("{} of {}{}, {}", format_count(header_.n_chunks), format_count(header_.chunk_size),
                    rest == 0 ? "" : fmt::format(" (the last {})", rest), name_of(view_.declarations().order).words));
    if (report_.paged) {
      const PagedFile& file = *report_.paged;
      const std::string name = view_.archive() != nullptr    ? archive_name(*view_.archive())
                               : file.codec() == Codec::none ? "direct"
                                                             : "packed";
      row("profile", fmt::format("{}, {} levels of detail in {} pages of at most {} chunks", name, file.n_levels(),
                                 format_count(file.n_pages()), file.page_chunks()));
    } else if (view_.coded()) {
      const FrameTable& frames = view_.frames(SectionType::sh);
      const std::string name = view_.archive() == nullptr ? "packed" : archive_name(*view_.archive());
      row("profile",
          fmt::format("{}, {} frames of {}", name, format_count(frames.frames.size()), format_count(frames.rows)));
    } else {
      row("profile", "direct");
    }
    if (const auto& p = view_.provenance()) {
      row("source", fmt::format("\"{}\", {} bytes, xxh3 {:016x}", escape_untrusted(p->source_name, ascii_),
                                format_count(p->source_bytes), p->source_xxh3));
      row("written by", fmt::format("\"{}\"", escape_untrusted(p->tool, ascii_)));
    } else {
      row("source", "not stated");
    }
  }

  void declarations() {
    const Declarations& d = view_.declarations();
    line("\ndeclarations");
    if (const auto right = right_handed(d.axes)) {
      row("axes", fmt::format("x {}, y {}, z {} ({}-handed)", name_of(d.axes[0]).words, name_of(d.axes[1]).words,
                              name_of(d.axes[2]).words, *right ? "right" : "left"));
    } else {
      row("axes", "not declared");
    }
    row("unit", d.metres_per_unit > 0 ? fmt::format("{:.6g} m", d.metres_per_unit) : "unknown");
    if (d.crs != Crs()) {
      row("CRS", fmt::format("\"{}\"{}", escape_untrusted(d.crs.text, ascii_),
                             d.crs.axes[0] == Axis::undeclared
                                 ? ""
                                 : fmt::format(", along {}, {}, {}", name_of(d.crs.axes[0]).words,
                                               name_of(d.crs.axes[1]).words, name_of(d.crs.axes[2]).words)));
    }
    row("colour", fmt::format("{}; SH basis {}", name_of(d.colour_space).words, name_of(d.sh_basis).words));
    row("kernel",
        fmt::format("{}, {:.4g} sigma; alpha {} to {:.4g}; stops at transmittance {:.4g}", name_of(d.kernel).words,
                    d.cutoff_sigma, alpha(d.alpha_threshold), d.alpha_max, d.transmittance_min));
    row("anti-aliasing", fmt::format("{}, low-pass {:.4g} px^2", name_of(d.aa_mode).words, d.low_pass_px2));
    row("depth", fmt::format("{:.6g} .. {:.6g}, {}, {}; sorted {}", d.z_near, d.z_far, name_of(d.depth_mapping).words,
                             name_of(d.depth_source).words, name_of(d.sort_metric).words));
    if (d.origin != kNoOrigin) {
      row("origin", fmt::format("x {}, y {}, z {}; means are relative to it", d.origin[0], d.origin[1], d.origin[2]));
    }
    if (const FirstView& v = d.first_view; v != FirstView()) {
      row("first view", fmt::format("from {}, at {:.6g}, {:.6g}, {:.6g}, looking at {:.6g}, {:.6g}, {:.6g}",
                                    v.kind == ViewKind::inside ? "inside" : "outside", v.position[0], v.position[1],
                                    v.position[2], v.pivot[0], v.pivot[1], v.pivot[2]));
    }
    box("means", d.full);
    box(fmt::format("  {:.3g}% of them", 100 * static_cast<double>(d.robust_fraction)), d.robust);
    row("from source", fmt::format("{} Gaussians, {} dropped, {} repaired", format_count(d.n_source),
                                   format_count(d.n_dropped), format_count(d.n_repaired)));
    row("FP16 limits",
        fmt::format("scale x 2^{}: {} subnormal, {} zero; opacity: {} zero, {} one", header_.scale_exponent,
                    format_count(d.n_scale_subnormal), format_count(d.n_scale_zero), format_count(d.n_opacity_zero),
                    format_count(d.n_opacity_one)));
  }

  static std::string alpha(float threshold) {
    return threshold == 1.f / 255.f ? "1/255" : fmt::format("{:.4g}", threshold);
  }

  void box(const std::string& key, const Box& b) {
    std::string text;
    for (std::size_t k = 0; k < 3; ++k) {
      text += fmt::format("{} {:<27}", "xyz"[k], fmt::format("{:.5g} .. {:.5g}", b.min[k], b.max[k]));
    }
    row(key, text);
  }

  void sections() {
    line("\nsections  {:<24}{:>16}{:>16}{:>16}  {:<7}{:>7}{:>9}  {:<16}{}", "content", "offset", "stored", "decoded",
         "codec", "B/Gauss", "share", "xxh3", report_.hashes.empty() ? "" : "  check");
    std::uint64_t stored = 0, decoded = 0;
    for (std::size_t i = 0; i < view_.sections().size(); ++i) {
      const SectionEntry& s = view_.sections()[i];
      stored += s.stored_bytes;
      const char* content = describe(static_cast<SectionType>(s.type));
      const bool known = *content != '\0';  // else its decoded size is unknown
      decoded += known ? s.decoded_bytes : s.stored_bytes;
      const char* check = report_.hashes.empty()        ? ""
                          : !is_present(report_, s)     ? "  INCOMPLETE"
                          : report_.hashes[i] == s.xxh3 ? "  OK"
                                                        : "  DAMAGED";
      line("  {:<8}{:<24}{:>16}{:>16}{:>16}  {:<7}{:>7.2f}{:>8.2f}%  {:016x}{}",
           escape_untrusted(four_characters(s.type), true), known ? content : "unknown, skipped",
           format_count(s.offset), format_count(s.stored_bytes), known ? format_count(s.decoded_bytes) : "?",
           codec_name(s), bytes_per_gaussian(s.stored_bytes, header_), share(s.stored_bytes), s.xxh3, check);
    }
    const std::uint64_t rest = header_.file_bytes - stored;
    line("  {:<32}{:>16}{:>16}{:>16}  {:<7}{:>7.2f}{:>8.2f}%", "header, table, padding", "", format_count(rest),
         format_count(rest), "", bytes_per_gaussian(rest, header_), share(rest));
    line("  {:<32}{:>16}{:>16}{:>16}  {:<7}{:>7.2f}{:>8.2f}%", "total", "", format_count(header_.file_bytes),
         format_count(decoded + rest), "", bytes_per_gaussian(header_.file_bytes, header_), 100.0);
    if (!report_.verified) return;
    if (!report_.paged) return line("  verified: every checksum and every value obeys the specification");
    line(
        "  verified: {} and every value obeys the specification; errors grow from page to parent, and each parent's "
        "box "
        "holds its children",
        report_.paged->complete() ? "every checksum" : "every checksum of what is present");
  }

  void levels() {
    const PagedFile& file = *report_.paged;
    line("\n{:<12}{:>10}{:>10}{:>16}{:>16}{:>9}{:>24}", "levels", "pages", "there", "Gaussians", "stored", "B/Gauss",
         "error, world units/px");
    for (std::size_t i = report_.levels.size(); i-- > 0;) {
      const LevelReport& level = report_.levels[i];
      line("  {:<10}{:>10}{:>10}{:>16}{:>16}{:>9.2f}{:>24}", i == 0 ? "0, finest" : std::to_string(i),
           format_count(level.n_pages), format_count(level.n_present), format_count(level.n_gaussians),
           format_count(level.stored_bytes),
           static_cast<double>(level.stored_bytes) / static_cast<double>(level.n_gaussians),
           fmt::format("{:.4g} .. {:.4g}", level.min_error, level.max_error));
    }
    if (report_.levels_check) levels_check(*report_.levels_check);
    if (const std::uint32_t n = file.n_pages_with_origins(); n != 0)
      row("far apart", fmt::format("{} pages have origins of their own", format_count(n)));
    if (file.quality_db() > 0) row("quality", fmt::format("{:.4g} dB from a page's error on", file.quality_db()));
  }

  void levels_check(const LevelsCheck& check) {
    line(
        "  {} of {} pages above the leaves compared with their children: {} with an error of less than 1/{} of the "
        "measured one",
        format_count(check.n_checked), format_count(check.n_inner), format_count(check.refuted.size()),
        check.tolerance);
    if (check.refuted.empty()) return;
    constexpr std::size_t kShown = 10;
    line("  {:<10}{:>10}{:>16}{:>16}{:>16}", "REFUTED", "level", "record at", "error", "measured");
    for (std::size_t i = 0; i < std::min(kShown, check.refuted.size()); ++i) {
      const RefutedPage& r = check.refuted[i];
      const lod::Page& page = report_.paged->pages()[r.page];
      line("  page {:<5}{:>10}{:>16}{:>16.4g}{:>16.4g}", r.page, page.level,
           format_count(record_offset(*report_.paged, r.page)), page.error, r.measured);
    }
    if (check.refuted.size() > kShown) line("  and {} more", format_count(check.refuted.size() - kShown));
  }

  void archive(const ArchiveParameters& p) {
    line("\narchive: steps, and the largest errors that its writer has verified");
    const bool draco = p.codec == Codec::archive_draco;
    row("means", fmt::format("2^{} cells from the middle to {:.4g}, {:.4g}, {:.4g} on each side, coarser in proportion "
                             "beyond; {}",
                             p.mean_cells, p.half_width[0], p.half_width[1], p.half_width[2],
                             draco ? fmt::format("error at most {:.2g} of that or of the distance", p.bound_mean)
                                   : "finer where it shows"));
    row("opacity", fmt::format("{} levels; error {}at most {:.2g}", p.opacity_levels, draco ? "" : "of its root ",
                               p.bound_opacity));
    if (draco) {
      row("steps", fmt::format("times importance^-{:.3g}, classes of {:.3g} octaves from the least seen to the most",
                               p.slope / 2, p.class_octaves));
      classes_of_draco(p);
    } else {
      row("steps",
          fmt::format("{:.4g}; fall with importance, classes of an octave from the least seen to the most", p.step));
      line("  {:<8}{:>12}{:>12}{:^22}{:^22}", "class", "means", "covariance", "SH degree 0", "SH above");
      line("  {0:<8}{1:>12}{1:>12}{2:>10}{1:>12}{2:>10}{1:>12}", "", "bound", "step");
      for (std::size_t i = 0; i < p.classes.size(); ++i) {
        const ArchiveClass& c = p.classes[i];
        line("  {:<8}{:>12.3g}{:>12.3g}{:>10.3g}{:>12.3g}{:>10.3g}{:>12.3g}", i, c.bound_mean, c.bound_covariance,
             dc_step(c), c.bound_dc, c.sh_step, c.bound_sh);
      }
    }
  }

  void classes_of_draco(const ArchiveParameters& p) {
    line("  {:<8}{:^22}{:^22}{:^22}{:^22}", "class", "rotation, degrees", "ln(scale)", "SH degree 0", "SH above");
    line("  {0:<8}{1:>10}{2:>12}{1:>10}{2:>12}{1:>10}{2:>12}{1:>10}{2:>12}", "", "step", "bound");
    constexpr float kDegrees = 180 / std::numbers::pi_v<float>;
    for (std::size_t i = 0; i < p.classes.size(); ++i) {
      const ArchiveClass& c = p.classes[i];
      line("  {:<8}{:>10.3g}{:>12.3g}{:>10.3g}{:>12.3g}{:>10.3g}{:>12.3g}{:>10.3g}{:>12.3g}", i,
           2 * c.rotation_step * kDegrees, c.bound_rotation * kDegrees, scale_step(c), c.bound_scale, dc_step(c),
           c.bound_dc, c.sh_step, c.bound_sh);
    }
  }

  double share(std::uint64_t part) const {
    return 100 * static_cast<double>(part) / static_cast<double>(header_.file_bytes);
  }

  void steps() {
    const std::uint64_t n_sets = scene_.header().n_step_sets;
    if (n_sets == 0) return;
    if (n_sets == 1) {
      step_table("SH steps, one set", scene_.step_set(0).value());
      return;
    }
    line("\n{:<20}{:^30}{:^30}{:^30}", fmt::format("SH steps, {} sets", format_count(n_sets)), kChannels[0],
         kChannels[1], kChannels[2]);
    line("{0:<20}{1:>10}{2:>10}{3:>10}{1:>10}{2:>10}{3:>10}{1:>10}{2:>10}{3:>10}", "", "min", "median", "max");
    for (std::size_t degree = 0; degree <= header_.sh_degree; ++degree) {
      std::string text;
      for (const Spread& s : (*report_.steps)[degree]) {
        text += fmt::format("{:>10.3g}{:>10.3g}{:>10.3g}", s.min, s.median, s.max);
      }
      line("  {:<18}{}", fmt::format("degree {}", degree), text);
    }
  }

  void step_table(const std::string& name, const ShStepSet& set) {
    line("\n{:<20}{:>12}{:>12}{:>12}", name, kChannels[0], kChannels[1], kChannels[2]);
    for (std::size_t degree = 0; degree <= header_.sh_degree; ++degree) {
      const auto& s = set.step[degree];
      line("  {:<18}{:>12.6g}{:>12.6g}{:>12.6g}", fmt::format("degree {}", degree), s[0], s[1], s[2]);
    }
  }

  void chunks() {
    if (header_.n_chunks == 0) return;
    const ChunkStatistics& c = *report_.chunks;
    distribution_heading(fmt::format("chunks, {}", format_count(header_.n_chunks)));
    distribution("box diagonal", c.diagonal);
    distribution("radius, 3 sigma", c.radius);
    distribution("largest opacity", c.max_opacity);
  }

  void values() {
    if (header_.n_gaussians == 0) return;
    if (!report_.values) {
      if (!report_.error) line("\nvalues not read (--stats reads them)");
      return;
    }
    const ValueStatistics& v = *report_.values;
    distribution_heading(fmt::format("values, {}", format_count(v.n)));
    distribution("opacity", v.opacity);
    distribution("scale", v.scale);
    line("\n{:<20}{:>10}{:>10}{:>10}         |code|", "SH codes", "zero", "at 127", "entropy");
    for (std::size_t degree = 0; degree < v.sh.size(); ++degree) {
      const ShCodes& c = v.sh[degree];
      const auto percent = [&c](std::uint64_t n) {
        return c.n == 0 ? 0 : 100 * static_cast<double>(n) / static_cast<double>(c.n);
      };
      line("  {:<18}{:>9.2f}%{:>9.2f}%{:>6.2f} bit  {:>5} {} {}", fmt::format("degree {}", degree), percent(c.n_zero),
           percent(c.n_limit), c.entropy_bits, 0, sparkline(c.bins), kShCodeMax);
    }
    line("\n{:<20}{:^24}{:^24}{:^24}", "SH values", kChannels[0], kChannels[1], kChannels[2]);
    for (std::size_t degree = 0; degree < v.sh.size(); ++degree) {
      std::string ranges;
      for (std::size_t c = 0; c < 3; ++c) {
        ranges += fmt::format("{:^24}", fmt::format("{:>9.4g} .. {:<9.4g}", v.sh[degree].min[c], v.sh[degree].max[c]));
      }
      line("  {:<18}{}", fmt::format("degree {}", degree), ranges);
    }
    if (v.n_illegal != 0) line("  {} stored numbers are not legal: run with --verify", format_count(v.n_illegal));
  }

  void distribution_heading(const std::string& name) {
    line("\n{:<20}{:>10}{:>10}{:>10}", name, "min", "median", "max");
  }

  void distribution(const char* name, const Distribution& d) {
    const auto bound = [&d](double x) { return d.logarithmic ? fmt::format("1e{:.0f}", x) : fmt::format("{:.0f}", x); };
    line("  {:<18}{:>10.4g}{:>10.4g}{:>10.4g}  {:>5} {} {:<6}{}", name, d.spread.min, d.spread.median, d.spread.max,
         bound(d.low), sparkline(d.bins), bound(d.high),
         d.logarithmic && d.n_zero != 0 ? fmt::format("and {} zero", format_count(d.n_zero)) : "");
  }

  // Heights are proportional to the fullest bin; any bin that is not empty shows.
  std::string sparkline(const std::array<std::uint64_t, kInfoBins>& bins) const {
    constexpr const char* kBlocks[9] = {" ", "▁", "▂", "▃", "▄", "▅", "▆", "▇", "█"};
    constexpr const char* kLetters[9] = {" ", ".", ":", "-", "=", "+", "*", "%", "#"};
    const double fullest = static_cast<double>(std::max<std::uint64_t>(1, std::ranges::max(bins)));
    std::string text = "|";
    for (const std::uint64_t count : bins) {
      const auto height = static_cast<std::size_t>(std::lround(8 * static_cast<double>(count) / fullest));
      const std::size_t shown = count == 0 ? 0 : std::clamp<std::size_t>(height, 1, 8);
      text += (ascii_ ? kLetters : kBlocks)[shown];
    }
    return text + "|";
  }

  void rows_of_chunk(const ChunkReport& c) {
    bytes(SectionType::chunks, c.index, 1, kChunkEntryBytes);
    bytes(SectionType::sh_steps, c.entry.step_set, 1, kStepSetBytes);
    bytes(SectionType::means, c.first, c.entry.count, kMeanBytes);
    bytes(SectionType::geometry, c.first, c.entry.count, kGeometryBytes);
    bytes(SectionType::sh, c.first, c.entry.count, sh_bytes(header_.sh_degree));
  }

  void page_of_chunk(const ChunkReport& c) {
    const std::uint32_t i = leaf_of_row(*report_.paged, c.first);
    const StoredPage& stored = report_.paged->stored(i);
    line("  {:<4}{:>16}{:>14}{:>10}", "PAGE", format_count(stored.offset), format_count(stored.stored_bytes),
         format_count(i));
  }

  void bytes(SectionType type, std::uint64_t first, std::uint64_t count, std::uint64_t row_bytes) {
    const StoredRows rows = stored_rows(view_, type, first, count, row_bytes);
    line("  {:<4}{:>16}{:>14}{:>10}", four_characters(static_cast<std::uint32_t>(type)), format_count(rows.offset),
         format_count(rows.bytes), rows.frame ? format_count(*rows.frame) : "");
  }

  const InfoReport& report_;
  const FileView& view_;
  const FileView& scene_;  // the same scene without levels
  const Header& header_;
  bool ascii_;
};

}  // namespace

std::string info_text(const InfoReport& report, bool ascii) {
  if (!report.view || (report.chunk_asked && !report.chunk)) return "";
  const bool page = report.page_asked && report.paged && *report.page_asked < report.paged->n_pages();
  if (report.page_asked && !page) return "";
  TextReport text(report, ascii);
  if (page) return text.page();
  return report.chunk ? text.chunk() : text.file();
}

}  // namespace rgs::tool
