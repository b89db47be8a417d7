// audit_folder.cpp - pairs by stem; a pair's JSON file is its result and its proof of what it was made from.
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
#include "audit_page.hpp"
#include "audit_report.hpp"
#include "audit_text.hpp"
#include "info_escape.hpp"
#include "input_files.hpp"
#include "rgs/file.hpp"

namespace rgs::audit {
namespace {

namespace fs = std::filesystem;
using Json = nlohmann::ordered_json;
using Status = FolderRow::Status;

constexpr const char* kTableStem = "index";  // index.html, index.json, index.csv

struct Pair {
  std::string source, asset;  // empty: there is none
};

const char* name_of(Status status) {
  switch (status) {
    case Status::passed: return "passed";
    case Status::gate_failed: return "gate failed";
    case Status::error: return "error";
    case Status::unpaired: return "unpaired";
  }
  return "";
}

rgs::Status write_text(const fs::path& path, const std::string& text, bool overwrite) {
  auto file = AtomicFile::create(path.string(), {.overwrite = overwrite, .sync = false});
  if (!file) return tl::unexpected(file.error());
  if (auto ok = file->write_at(0, std::as_bytes(std::span(text))); !ok) return ok;
  return file->commit().map([](double) {});
}

Outcome<void> collect(const std::string& folder, const char* extension, std::map<std::string, Pair>& pairs,
                      std::string Pair::*side) {
  std::error_code failed;
  for (fs::directory_iterator it(folder, failed), end; !failed && it != end; it.increment(failed))
    if (it->path().extension() == extension) pairs[it->path().stem().string()].*side = it->path().string();
  if (!failed) return {};
  return make_error(folder, {Errc::open_failed, Error::kNone, "the folder cannot be read", Error::kNone, Error::kNone,
                             failed.value()});
}

// A folder with something for each pair, or one thing for all.
std::string own_or_common(const std::string& path, const std::string& own) {
  std::error_code ignored;
  const fs::path candidate = fs::path(path) / own;
  return !path.empty() && fs::exists(candidate, ignored) ? candidate.string() : path;
}

// Pictures were made, and none of them shows the scene.
bool is_unrated(const FolderRow& row) {
  return row.n_views != 0 && row.n_rated == 0;
}

// Absent from a damaged or older file: the pair is then audited again.
std::optional<double> real(const Json& j, const char* key) {
  if (!j.is_object() || !j.contains(key)) return {};
  return j[key].is_number() ? j[key].get<double>() : std::numeric_limits<double>::infinity();
}

FolderRow row_of(const std::string& stem, const Json& j) {
  FolderRow row;
  row.stem = stem;
  row.headline = j["verdict"]["headline"].get<std::string>();
  row.grade = j["verdict"]["grade"].get<std::string>();
  row.status = j["gate"]["holds"].get<bool>() ? Status::passed : Status::gate_failed;
  row.exit_code = row.status == Status::passed ? tool::kSuccess : tool::kGate;
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

std::optional<FolderRow> earlier_result(const std::string& stem, const fs::path& json, const std::string& fingerprint) {
  const auto file = MappedFile::open(json.string());
  if (!file) return {};
  const auto bytes = file->bytes();
  const char* text = reinterpret_cast<const char*>(bytes.data());
  try {
    const Json j = Json::parse(text, text + bytes.size());
    if (j.at("schema") != "rgs-audit/2" || j.at("fingerprint") != fingerprint) return {};
    FolderRow row = row_of(stem, j);
    row.reused = true;
    return row;
  } catch (const Json::exception&) {
    return {};
  }
}

class Folder {
 public:
  explicit Folder(const FolderOptions& options) : options_(options), out_(options.out) {}

  Outcome<std::vector<FolderRow>> run() {
    std::map<std::string, Pair> pairs;
    if (auto ok = collect(options_.audit.source, ".ply", pairs, &Pair::source); !ok) return tl::unexpected(ok.error());
    if (auto ok = collect(options_.audit.asset, ".rgs", pairs, &Pair::asset); !ok) return tl::unexpected(ok.error());
    if (pairs.empty())
      return make_error(options_.audit.source, {Errc::bad_argument, Error::kNone, "no .ply and no .rgs file to audit"});
    std::error_code failed;
    fs::create_directories(out_, failed);
    if (failed)
      return make_error(options_.out, {Errc::write_failed, Error::kNone, "the folder cannot be made", Error::kNone,
                                       Error::kNone, failed.value()});
    for (const auto& pair : pairs) {
      rows_.push_back(audit(pair.first, pair.second));
      print(rows_.back(), pairs.size());
      if (auto ok = write_tables(); !ok) return tl::unexpected(ok.error());
    }
    return std::move(rows_);
  }

 private:
  FolderRow audit(const std::string& stem, const Pair& pair) {
    if (stem == kTableStem)
      return failed_row(stem, {"",
                               {Errc::bad_argument, Error::kNone,
                                "the folder's table has this name: rename the pair, and its report finds a place"}});
    if (pair.source.empty() || pair.asset.empty()) {
      FolderRow row;
      row.stem = stem;
      row.status = Status::unpaired;
      row.error = pair.asset.empty() ? "no .rgs file of this name" : "no .ply file of this name";
      row.exit_code = tool::kInputOutput;
      return row;
    }
    Options options = options_.audit;
    options.source = pair.source;
    options.asset = pair.asset;
    options.cameras = own_or_common(options.cameras, stem + ".json");
    options.photos = own_or_common(options.photos, stem);
    tool::InputFiles inputs;
    inputs.add(options.source);
    inputs.add(options.asset);
    inputs.add_cameras(options.cameras);
    inputs.add_pictures(options.photos);
    const auto fingerprint = audit::fingerprint(options);
    if (!fingerprint) return failed_row(stem, fingerprint.error());
    const fs::path json = out_ / (stem + ".json"), page = out_ / (stem + ".html");
    std::error_code ignored;
    if (fs::exists(page, ignored))
      if (auto row = earlier_result(stem, json, *fingerprint)) return *std::move(row);
    for (const fs::path& path : {json, page})
      if (!options_.overwrite && fs::exists(path, ignored))
        return failed_row(stem, {path.string(),
                                 {Errc::output_exists, Error::kNone,
                                  "a result of other inputs or options; pass --overwrite to replace it"}});
    tool::Progress progress(options_.quiet ? tool::Progress::Mode::quiet : tool::Progress::Mode::automatic);
    auto report = audit::run(options, progress);
    // That a file changed explains whatever was found wrong in it.
    if (const auto changed = inputs.changed()) return failed_row(stem, {*changed, tool::kFileChanged});
    if (!report) return failed_row(stem, report.error());
    report->fingerprint = *fingerprint;
    evaluate(options_.conditions, *report);
    const std::string text = audit_json(*report);
    // The JSON file last: it says that the pair is done.
    if (auto ok = write_text(page, audit_html(*report), true); !ok)
      return failed_row(stem, {page.string(), ok.error()});
    if (auto ok = write_text(json, text, true); !ok) return failed_row(stem, {json.string(), ok.error()});
    return row_of(stem, Json::parse(text));
  }

  static FolderRow failed_row(const std::string& stem, const Failure& failure) {
    FolderRow row;
    row.stem = stem;
    row.error = (failure.subject.empty() ? "" : failure.subject + ": ") + tool::describe(failure.error);
    row.exit_code = exit_code(failure.error.code);
    return row;
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
      if (auto ok = write_text(name, text, true); !ok) return make_error(name.string(), ok.error());
    return {};
  }

  // One harmless cell: escaped as on a terminal, and with an apostrophe before what a spreadsheet would calculate, which
  // the full-width forms of the same signs are in some.
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
    text += ",error\n";
    const auto cell = [](const std::optional<double>& v) { return v ? fmt::format("{}", *v) : std::string(); };
    for (const FolderRow& r : rows_) {
      fmt::format_to(std::back_inserter(text), "{},{},{},{},{},{},{},{},{},{},{},{},{},{}", quoted(r.stem),
                     name_of(r.status), r.grade, r.source_bytes, r.asset_bytes, r.n_gaussians, r.ratio,
                     r.bytes_per_gaussian, r.n_views, r.n_rated, cell(r.psnr), cell(r.worst_psnr), cell(r.ssim),
                     cell(r.loss));
      for (std::size_t i = 0; i < kDistances.size(); ++i)
        text += "," + cell(r.levels_psnr[i]) + "," + cell(r.levels_drawn[i]);
      text += "," + quoted(r.error) + "\n";
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
    return Json{{"schema", "rgs-audit-index/2"}, {"pairs", std::move(rows)}}.dump(2, ' ', true,
                                                                                  Json::error_handler_t::replace) +
           "\n";
  }

  // Trouble first, then the worst pictures.
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
        html(r.stem), colour, html(r.headline), std::string(name_of(r.status)) + (is_unrated(r) ? ", unrated" : ""),
        tool::format_bytes(r.source_bytes), tool::format_bytes(r.asset_bytes), r.ratio, r.bytes_per_gaussian,
        cell(r.psnr, 2), cell(r.worst_psnr, 2), cell(r.ssim, 6), cell(r.loss, 4), link_to_file(r.stem + ".html"));
  }

  const FolderOptions& options_;
  fs::path out_;
  std::vector<FolderRow> rows_;
};

}  // namespace

Outcome<std::vector<FolderRow>> audit_folder(const FolderOptions& options) {
  return Folder(options).run();
}

int exit_code_of(const std::vector<FolderRow>& rows) {
  int code = tool::kSuccess;
  for (const FolderRow& row : rows) {
    if (row.exit_code == tool::kSuccess) continue;
    if (row.exit_code != tool::kGate) return row.exit_code;
    code = tool::kGate;
  }
  return code;
}

}  // namespace rgs::audit
