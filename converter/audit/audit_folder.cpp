// audit_folder.cpp - pairs files by stem; a pair's JSON file is its result and records its inputs.
// SPDX-License-Identifier: Apache-2.0
#include "audit_folder.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <filesystem>
#include <iterator>
#include <limits>
#include <map>
#include <nlohmann/json.hpp>

#include "audit_distances.hpp"
#include "audit_encoding.hpp"
#include "audit_gate.hpp"
#include "audit_json.hpp"
#include "audit_junit.hpp"
#include "audit_page.hpp"
#include "audit_report.hpp"
#include "audit_source.hpp"
#include "audit_text.hpp"
#include "info_escape.hpp"
#include "input_files.hpp"
#include "rgs/file.hpp"
#include "rgs/utf8_path.hpp"
#include "scene_list.hpp"

namespace rgs::audit {
namespace {

namespace fs = std::filesystem;
using Json = nlohmann::ordered_json;
using Status = FolderRow::Status;

constexpr const char* kTableStem = "index";  // index.html, index.json, index.csv

const char* name_of(Status status) {
  switch (status) {
    case Status::passed: return "passed";
    case Status::gate_failed: return "gate failed";
    case Status::error: return "error";
    case Status::unpaired: return "unpaired";
  }
  return "";
}

struct Candidates {
  std::vector<std::string> sources, rgs_sources, assets, rgs_assets;
};

// A mesh or point cloud among the scenes needs no partner.
bool holds_no_splats(const std::string& path, const ReadOptions& options) {
  const auto source = Source::open(path, options, {});
  return !source && source.error().code == Errc::not_gaussian_splats;
}

std::string file_names(const std::vector<std::string>& paths) {
  std::string text;
  for (const std::string& path : paths) text += (text.empty() ? "" : ", ") + detail::path_of(path).filename().string();
  return text;
}

Pair choose(const Candidates& c) {
  const std::vector<std::string>& sources = c.sources.empty() ? c.rgs_sources : c.sources;
  const std::vector<std::string>& assets = c.rgs_assets.empty() && !sources.empty() ? c.assets : c.rgs_assets;
  Pair pair;
  if (sources.size() > 1) pair.error = "more than one source of this name: " + file_names(sources);
  if (assets.size() > 1) pair.error = "more than one asset of this name: " + file_names(assets);
  if (!pair.error.empty()) return pair;
  if (!sources.empty()) pair.source = sources.front();
  if (!assets.empty()) pair.asset = assets.front();
  if (pair.asset.empty()) pair.error = "no .rgs file of this name";
  if (pair.source.empty()) pair.error = "no source of this name";
  return pair;
}

// A folder with an entry for each pair, or one path for all.
std::string own_or_common(const std::string& path, const std::string& own) {
  std::error_code ignored;
  const fs::path candidate = detail::path_of(path) / detail::path_of(own);
  return !path.empty() && fs::exists(candidate, ignored) ? candidate.string() : path;
}

bool is_unrated(const FolderRow& row) {
  return row.n_views != 0 && row.n_rated == 0;
}

// Absent from a damaged or older file: the pair is then audited again.
std::optional<double> real(const Json& j, const char* key) {
  if (!j.is_object() || !j.contains(key)) return {};
  return j[key].is_number() ? j[key].get<double>() : std::numeric_limits<double>::infinity();
}

std::vector<Condition> gate_of(const Json& j) {
  std::vector<Condition> gate;
  for (const Json& c : j["conditions"]) {
    Condition& out = gate.emplace_back();
    out.name = c["name"].get<std::string>();
    out.limit = c["limit"].get<double>();
    out.at_least = c["sense"] == "at_least";
    out.holds = c["holds"].get<bool>();
    out.found = !c["measured"].get<bool>() ? std::numeric_limits<double>::quiet_NaN()
                : c["found"].is_number()   ? c["found"].get<double>()
                                           : std::numeric_limits<double>::infinity();
  }
  return gate;
}

FolderRow row_of_json(const std::string& stem, const Json& j) {
  FolderRow row;
  row.stem = stem;
  row.headline = j["verdict"]["headline"].get<std::string>();
  row.grade = j["verdict"]["grade"].get<std::string>();
  row.status = j["gate"]["holds"].get<bool>() ? Status::passed : Status::gate_failed;
  row.exit_code = row.status == Status::passed ? tool::kSuccess : tool::kGate;
  row.gate = gate_of(j["gate"]);
  row.seconds = j["seconds"].get<double>();
  row.source_bytes = j["source"]["bytes"].get<std::uint64_t>();
  row.asset_bytes = j["asset"]["bytes"].get<std::uint64_t>();
  row.n_gaussians = j["asset"]["gaussians"].get<std::uint64_t>();
  row.ratio = j["size"]["ratio"].get<double>();
  row.bytes_per_gaussian = j["size"]["bytes_per_gaussian"].get<double>();
  if (j.contains("distances")) {
    for (const Json& far : j["distances"]["rows"]) {
      const auto at = std::find(kDistances.begin(), kDistances.end(), far["far"].get<int>());
      if (at == kDistances.end()) continue;
      const auto i = static_cast<std::size_t>(at - kDistances.begin());
      row.levels_psnr[i] = real(far["levels"], "psnr");
      row.levels_drawn[i] = real(far, "drawn");
    }
  }
  if (!j.contains("rendered")) return row;
  const Json& r = j["rendered"];
  row.n_views = r["n_views"].get<std::uint64_t>();
  row.n_rated = r["n_rated"].get<std::uint64_t>();
  row.psnr = real(r, "psnr");
  row.worst_psnr = real(r, "worst_psnr");
  row.ssim = real(r, "ssim");
  row.loss = real(r["photos"], "loss");
  return row;
}

std::string text_of(const MappedFile& file) {
  return {reinterpret_cast<const char*>(file.bytes().data()), file.bytes().size()};
}

class Folder {
 public:
  explicit Folder(const FolderOptions& options) : options_(options), out_(detail::path_of(options.out)) {}

  Outcome<std::vector<FolderRow>> run() {
    const auto pairs = pairs_of(options_.audit);
    if (!pairs) return tl::unexpected(pairs.error());
    for (const auto& pair : *pairs) {
      // A pair may lie in a subfolder.
      const fs::path folder = (out_ / detail::path_of(pair.first)).parent_path();
      std::error_code failed;
      fs::create_directories(folder, failed);
      if (failed)
        return make_error(folder.string(), {Errc::write_failed, Error::kNone, "cannot create the folder", Error::kNone,
                                            Error::kNone, failed.value()});
      rows_.push_back(audit(pair.first, pair.second));
      print(rows_.back(), pairs->size());
      if (auto ok = write_tables(); !ok) return tl::unexpected(ok.error());
    }
    return std::move(rows_);
  }

 private:
  FolderRow audit(const std::string& stem, const Pair& pair) {
    if (stem == kTableStem)
      return failed_row(stem,
                        {"", {Errc::bad_argument, Error::kNone, "the folder's table has this name; rename the pair"}});
    if (!pair.error.empty()) {
      FolderRow row;
      row.stem = stem;
      row.status = Status::unpaired;
      row.error = pair.error;
      row.exit_code = tool::kInputOutput;
      return row;
    }
    Options options = options_.audit;
    options.source = pair.source;
    options.asset = pair.asset;
    options.cameras = own_or_common(options.cameras, stem + ".json");
    options.photos = own_or_common(options.photos, stem);
    tool::InputFiles inputs;
    inputs.add_scene(options.source);
    inputs.add_scene(options.asset);
    inputs.add_cameras(options.cameras);
    inputs.add_pictures(options.photos);
    const auto fingerprint = audit::fingerprint(options);
    if (!fingerprint) return failed_row(stem, fingerprint.error());
    const fs::path json = out_ / detail::path_of(stem + ".json"), page = out_ / detail::path_of(stem + ".html");
    std::error_code ignored;
    const auto earlier = earlier_audit(json.string(), *fingerprint, options_.conditions);
    if (earlier) {
      if (const auto changed = inputs.changed()) return failed_row(stem, {*changed, tool::kFileChanged});
      if (auto row = reuse(stem, *earlier, json, page, *fingerprint)) return *std::move(row);
    }
    const auto is_other = [&](const fs::path& path) {
      if (options_.overwrite || !fs::exists(path, ignored)) return false;
      if (path == json) return !earlier;
      // Without its JSON file it is the rest of a killed run, if it has the same inputs.
      const auto file = MappedFile::open(path.string());
      return !file || !(earlier ? is_audit_page(text_of(*file)) : is_audit_page_of(text_of(*file), *fingerprint));
    };
    for (const fs::path& path : {json, page})
      if (is_other(path))
        return failed_row(stem, {path.string(),
                                 {Errc::output_exists, Error::kNone,
                                  "a result for other inputs or options; pass --overwrite to replace it"}});
    tool::Progress progress(options_.quiet ? tool::Progress::Mode::quiet : tool::Progress::Mode::automatic);
    auto report = audit::run(options, progress);
    // A change of a file explains any other error.
    if (const auto changed = inputs.changed()) return failed_row(stem, {*changed, tool::kFileChanged});
    if (!report) return failed_row(stem, report.error());
    report->fingerprint = *fingerprint;
    evaluate(options_.conditions, *report);
    const std::string text = audit_json(*report);
    // The JSON file last: it says that the pair is done.
    if (auto ok = write_text(page.string(), audit_html(*report), true); !ok)
      return failed_row(stem, {page.string(), ok.error()});
    if (auto ok = write_text(json.string(), text, true); !ok) return failed_row(stem, {json.string(), ok.error()});
    return row_of_json(stem, Json::parse(text));
  }

  // An earlier result under the current conditions. None if its page is gone or differs.
  std::optional<FolderRow> reuse(const std::string& stem, const EarlierAudit& earlier, const fs::path& json,
                                 const fs::path& page, const std::string& fingerprint) const {
    const auto file = MappedFile::open(page.string());
    if (!file) return {};
    const auto text = with_gate(text_of(*file), fingerprint, earlier.verdict, earlier.gate);
    if (!text) return {};
    if (*text != text_of(*file))
      if (auto ok = write_text(page.string(), *text, true); !ok) return failed_row(stem, {page.string(), ok.error()});
    if (earlier.changed)
      if (auto ok = write_text(json.string(), earlier.json, true); !ok)
        return failed_row(stem, {json.string(), ok.error()});
    try {
      FolderRow row = row_of_json(stem, Json::parse(earlier.json));
      row.reused = true;
      return row;
    } catch (const Json::exception&) {
      return {};
    }
  }

  void print(const FolderRow& row, std::size_t n) const {
    if (options_.quiet) return;
    const std::string& text = row.error.empty() ? row.headline : row.error;
    tool::print(fmt::format("[{}/{}] {}: {}{}\n", rows_.size(), n, tool::printable(row.stem), tool::printable(text),
                            row.reused ? " (as before)" : ""));
  }

  fs::path table(const char* extension) const { return out_ / (std::string(kTableStem) + "." + extension); }

  Outcome<void> write_tables() const {
    for (const auto& [name, text] :
         {std::pair(table("csv"), csv()), std::pair(table("json"), json()), std::pair(table("html"), page())})
      if (auto ok = write_text(name.string(), text, true); !ok) return make_error(name.string(), ok.error());
    if (options_.junit.empty()) return {};
    if (auto ok = write_text(options_.junit, junit_xml(rows_), true); !ok)
      return make_error(options_.junit, ok.error());
    return {};
  }

  // One safe cell: escaped as for a terminal, with an apostrophe before characters that spreadsheets evaluate; some
  // also evaluate their full-width forms.
  static std::string quoted(const std::string& text) {
    const std::string shown = tool::escape_untrusted(text, false, 4096);
    std::string out = "\"";
    const std::string_view start = std::string_view(shown).substr(std::min(shown.find_first_not_of(' '), shown.size()));
    for (const char* sign : {"=", "+", "-", "@", "\uFF1D", "\uFF0B", "\uFF0D", "\uFF20"})
      if (start.starts_with(sign)) out += '\'';
    for (const char c : shown) out += c == '"' ? "\"\"" : std::string(1, c);
    return out + '"';
  }

  std::string csv() const {
    std::string text =
        "name,status,grade,source_bytes,asset_bytes,gaussians,ratio,bytes_per_gaussian,n_views,n_rated,psnr,"
        "worst_psnr,ssim,loss";
    for (const int far : kDistances) text += fmt::format(",levels_psnr_{0}x,levels_drawn_{0}x", far);
    text += ",failed_conditions,error\n";
    const auto cell = [](const std::optional<double>& v) { return v ? fmt::format("{}", *v) : std::string(); };
    for (const FolderRow& r : rows_) {
      fmt::format_to(std::back_inserter(text), "{},{},{},{},{},{},{},{},{},{},{},{},{},{}", quoted(r.stem),
                     name_of(r.status), r.grade, r.source_bytes, r.asset_bytes, r.n_gaussians, r.ratio,
                     r.bytes_per_gaussian, r.n_views, r.n_rated, cell(r.psnr), cell(r.worst_psnr), cell(r.ssim),
                     cell(r.loss));
      for (std::size_t i = 0; i < kDistances.size(); ++i)
        text += "," + cell(r.levels_psnr[i]) + "," + cell(r.levels_drawn[i]);
      text += "," + quoted(failed_conditions(r.gate)) + "," + quoted(r.error) + "\n";
    }
    return text;
  }

  std::string json() const {
    const auto cell = [](const std::optional<double>& v) { return v && std::isfinite(*v) ? Json(*v) : Json(); };
    Json rows = Json::array();
    for (const FolderRow& r : rows_) {
      const bool measured = r.status == Status::passed || r.status == Status::gate_failed;
      Json row{{"name", r.stem}, {"status", name_of(r.status)}};
      if (measured) {
        row["report"] = r.stem + ".html";
        row["result"] = r.stem + ".json";
        row["verdict"] = r.headline;
        row["failed_conditions"] = Json::array();
        for (const Condition& c : r.gate)
          if (!c.holds) row["failed_conditions"].push_back(describe(c));
        row["grade"] = r.grade;
        row["source_bytes"] = r.source_bytes;
        row["asset_bytes"] = r.asset_bytes;
        row["gaussians"] = r.n_gaussians;
        row["ratio"] = r.ratio;
        row["bytes_per_gaussian"] = r.bytes_per_gaussian;
        row["n_views"] = r.n_views;
        row["n_rated"] = r.n_rated;
        if (r.n_rated != 0) {
          row["psnr"] = cell(r.psnr);
          row["worst_psnr"] = cell(r.worst_psnr);
          row["ssim"] = cell(r.ssim);
          row["loss"] = cell(r.loss);
        }
        Json distances = Json::array();
        for (std::size_t i = 0; i < kDistances.size(); ++i)
          if (r.levels_drawn[i])
            distances.push_back(
                {{"far", kDistances[i]}, {"psnr", cell(r.levels_psnr[i])}, {"drawn", cell(r.levels_drawn[i])}});
        if (!distances.empty()) row["distances"] = std::move(distances);
      } else {
        row["error"] = r.error;
      }
      rows.push_back(std::move(row));
    }
    return Json{{"schema", "rgs-audit-index/3"}, {"pairs", std::move(rows)}}.dump(2, ' ', true,
                                                                                  Json::error_handler_t::replace) +
           "\n";
  }

  // Failures first, then the worst pictures.
  std::string page() const {
    std::vector<const FolderRow*> rows;
    for (const FolderRow& r : rows_) rows.push_back(&r);
    std::stable_sort(rows.begin(), rows.end(), [](const FolderRow* a, const FolderRow* b) {
      return a->status != b->status ? a->status > b->status : a->worst_psnr.value_or(0) < b->worst_psnr.value_or(0);
    });
    const auto passed = std::count_if(rows_.begin(), rows_.end(), [](const FolderRow& r) { return r.exit_code == 0; });
    const auto n_unrated = std::count_if(rows_.begin(), rows_.end(), is_unrated);
    std::string text = page_begin("rgs-audit of " + options_.audit.asset);
    fmt::format_to(
        std::back_inserter(text),
        "<main>\n<p class=\"names\"><b>rgs-audit</b> &nbsp; {} &rarr; <b>{}</b></p>\n<h1>{} of {} pairs pass{}.</h1>\n"
        "<div class=\"wrap\" role=\"region\" tabindex=\"0\" aria-label=\"Pairs\"><table>\n<thead><tr><th>Pair</th>"
        "<th class=\"left\">Result</th><th>Source</th><th>Asset</th><th>Ratio</th><th>Bytes per Gaussian</th>"
        "<th>PSNR, dB</th><th>Worst view, dB</th><th>SSIM</th><th>Lost to photos, dB</th></tr></thead><tbody>\n",
        html(options_.audit.source), html(options_.audit.asset), passed, rows_.size(),
        n_unrated == 0 ? "" : fmt::format(", {} not rated", n_unrated));
    for (const FolderRow* row : rows) text += page_row(*row);
    return text + "</tbody></table></div>\n</main>\n" + page_end();
  }

  // A pair may lie in a subfolder; the rest of its name is not a path.
  static std::string link_to_report(const std::string& stem) {
    std::string link = ".";
    for (const fs::path& part : detail::path_of(stem + ".html")) link += link_to_file(part.string()).substr(1);
    return link;
  }

  static std::string page_row(const FolderRow& r) {
    const char* colour = r.status == Status::gate_failed ? "fair"
                         : r.status != Status::passed    ? "bad"
                         : is_unrated(r)                 ? "soft"
                                                         : "good";
    if (!r.error.empty())
      return fmt::format("<tr><td>{}</td><td class=\"left {}\">{}</td><td colspan=\"8\" class=\"left\">{}</td></tr>\n",
                         html(r.stem), colour, name_of(r.status), html(r.error));
    const auto cell = [](const std::optional<double>& v, int digits) {
      return !v ? std::string() : std::isfinite(*v) ? fmt::format("{:.{}f}", *v, digits) : "&infin;";
    };
    return fmt::format(
        "<tr><td><a href=\"{12}\">{0}</a></td><td class=\"left {1}\" title=\"{2}\">{3}</td><td>{4}</td><td>{5}</td>"
        "<td>{6:.2f}</td><td>{7:.2f}</td><td>{8}</td><td>{9}</td><td>{10}</td><td>{11}</td></tr>\n",
        html(r.stem), colour, html(r.headline),
        std::string(name_of(r.status)) + (is_unrated(r) ? ", unrated" : "") +
            (holds(r.gate) ? "" : ": " + html(failed_conditions(r.gate))),
        tool::format_bytes(r.source_bytes), tool::format_bytes(r.asset_bytes), r.ratio, r.bytes_per_gaussian,
        cell(r.psnr, 2), cell(r.worst_psnr, 2), cell(r.ssim, 6), cell(r.loss, 4), link_to_report(r.stem));
  }

  const FolderOptions& options_;
  fs::path out_;
  std::vector<FolderRow> rows_;
};

}  // namespace

Outcome<std::map<std::string, Pair>> pairs_of(const Options& options) {
  std::error_code ignored;
  const bool one_folder = fs::equivalent(detail::path_of(options.source), detail::path_of(options.asset), ignored);
  std::map<std::string, Candidates> candidates;
  std::map<std::string, Pair> pairs;
  const auto collect = [&](const std::string& folder, const std::string& other, bool is_source) -> Outcome<void> {
    // Either folder may lie in the other.
    const auto listed = tool::list_scenes(folder, one_folder ? std::vector<std::string>{} : std::vector{other}, true);
    if (!listed) return make_error(folder, listed.error());
    for (const tool::ListedScene& scene : listed->scenes) {
      const std::string stem = tool::scene_stem(scene.name);
      const bool is_rgs = scene.format == SplatFormat::rgs ||
                          (scene.format == SplatFormat::unknown && format_of_name(scene.name) == SplatFormat::rgs);
      if (!scene.readable && format_of_name(scene.name) == SplatFormat::unknown) {
        pairs[scene.name + "/"].error = "cannot read the folder";
        continue;
      }
      Candidates& c = candidates[stem];
      if (one_folder) {
        (is_rgs ? c.rgs_assets : c.sources).push_back(scene.path);
      } else if (is_source) {
        (is_rgs ? c.rgs_sources : c.sources).push_back(scene.path);
      } else {
        (is_rgs ? c.rgs_assets : c.assets).push_back(scene.path);
      }
    }
    return {};
  };
  if (auto ok = collect(options.source, options.asset, true); !ok) return tl::unexpected(ok.error());
  if (!one_folder)
    if (auto ok = collect(options.asset, options.source, false); !ok) return tl::unexpected(ok.error());
  for (const auto& [stem, c] : candidates) {
    const Pair pair = choose(c);
    const bool alone = !pair.error.empty() && c.rgs_assets.empty();
    if (pair.source.empty() && pair.asset.empty() && c.sources.empty() && c.rgs_assets.empty() && c.rgs_sources.empty())
      continue;  // files of other formats among the assets
    if (alone && c.sources.size() == 1 && holds_no_splats(c.sources.front(), options.read)) continue;
    pairs.emplace(stem, pair);
  }
  if (pairs.empty())
    return make_error(options.source, {Errc::bad_argument, Error::kNone, "no scene and no .rgs file to audit"});
  return pairs;
}

FolderRow row_of(const Report& report) {
  FolderRow row;
  row.stem = report.asset_name;
  row.headline = verdict(report).headline;
  row.gate = report.gate;
  row.status = report.gate_holds() ? Status::passed : Status::gate_failed;
  row.seconds = report.seconds;
  return row;
}

FolderRow failed_row(const std::string& stem, const Failure& failure) {
  FolderRow row;
  row.stem = stem;
  row.error = (failure.subject.empty() ? "" : failure.subject + ": ") + tool::describe(failure.error);
  row.exit_code = exit_code(failure.error.code);
  return row;
}

rgs::Status write_text(const std::string& path, const std::string& text, bool overwrite) {
  auto file = AtomicFile::create(path, {.overwrite = overwrite, .sync = false});
  if (!file) return tl::unexpected(file.error());
  if (auto ok = file->write_at(0, std::as_bytes(std::span(text))); !ok) return ok;
  return file->commit().map([](double) {});
}

Outcome<std::vector<FolderRow>> audit_folder(const FolderOptions& options) {
  return Folder(options).run();
}

int exit_code_of(const std::vector<FolderRow>& rows) {
  int code = tool::kSuccess;
  for (const FolderRow& row : rows) code = tool::worse_exit_code(code, row.exit_code);
  return code;
}

}  // namespace rgs::audit
