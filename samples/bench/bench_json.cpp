// bench_json.cpp - a report as JSON.
// SPDX-License-Identifier: Apache-2.0
#include <cmath>
#include <nlohmann/json.hpp>

#include "bench_report.hpp"
#include "rgs/ablation.hpp"

namespace rgs::bench {
namespace {

using nlohmann::ordered_json;

const char* name_of(math::Exp exp) {
  switch (exp) {
    case math::Exp::exact: return "exact";
    case math::Exp::paper: return "paper";
    case math::Exp::zero_mean: return "zero_mean";
  }
  return "";
}

ordered_json device_json(const DeviceInfo& d) {
  return {{"name", d.name},
          {"compute_capability", {d.capability_major, d.capability_minor}},
          {"multiprocessors", d.multiprocessors},
          {"clock_mhz", d.clock_mhz},
          {"memory_clock_mhz", d.memory_clock_mhz},
          {"memory_bytes", d.memory_bytes},
          {"l2_bytes", d.l2_bytes},
          {"driver_version", d.driver_version},
          {"runtime_version", d.runtime_version}};
}

ordered_json rates_json(const cuda::DeviceRates& r) {
  return {{"copy_bytes", r.copy_bytes},
          {"l2_bytes", r.l2_bytes},
          {"fp32_operations", r.fp32},
          {"special_operations", r.special},
          {"shared_loads", r.shared_loads}};
}

ordered_json options_json(const Configuration& c) {
  const bool is_turbo = c.options.pipeline == Pipeline::turbo;
  const PaperSteps o = steps_of(c.options, Backend::cuda);
  ordered_json json;
  json["attributes"] = c.compact ? "compact" : "fp32";
  json["turbo"] = is_turbo;
  json["tensor_cores"] = is_turbo && c.options.turbo.tensor_cores;
  json["front_end"] = o.front_end == PaperSteps::FrontEnd::fused ? "fused" : "separate";
  json["deterministic"] = is_turbo || o.deterministic || o.front_end == PaperSteps::FrontEnd::separate;
  json["extent"] = o.extent == math::Extent::square ? "square" : "ellipse";
  json["depth_order"] = o.depth_order == math::DepthOrder::exact ? "exact" : "quantized";
  if (o.depth_order == math::DepthOrder::quantized) {
    json["depth_mapping"] = *o.depth_mapping == DepthMapping::linear ? "linear" : "log";
    json["depth_range"] = *o.depth_range;
  }
  json["exponent"] = o.exponent == math::Exponent::direct ? "direct" : "folded";
  json["exp"] = name_of(o.exp);
  json["pixels_per_thread"] = o.pixels_per_thread;
  json["pixel_format"] = pixel_format_name(c.packed);
  return json;
}

// Infinite ratios (equal pictures) have no number in JSON; they become null.
ordered_json quality_json(const Quality& q) {
  ordered_json json = {
      {"psnr", q.psnr}, {"worst_psnr", q.worst_psnr}, {"ssim", q.ssim}, {"largest_difference", q.largest}};
  if (q.photo_psnr) json["photo_psnr"] = *q.photo_psnr;
  if (q.photo_loss) json["photo_loss"] = *q.photo_loss;
  return json;
}

ordered_json cost_json(const Cost& cost, double ms, const std::optional<cuda::DeviceRates>& rates) {
  const double per_second = ms > 0 ? 1e3 / ms : 0;
  ordered_json json = {{"ms", ms},
                       {"bytes", cost.bytes},
                       {"l2_bytes", cost.l2_bytes},
                       {"flops", cost.flops},
                       {"operations", cost.operations},
                       {"special", cost.special},
                       {"shared_loads", cost.shared_loads},
                       {"bytes_per_second", cost.bytes * per_second},
                       {"flops_per_second", cost.flops * per_second},
                       {"intensity", cost.intensity()}};
  if (rates) {
    const Floor floor = floor_of(cost, *rates);
    json["floor_ms"] = floor.ms;
    json["limit"] = floor.limit;
    json["time_over_floor"] = floor.ms > 0 ? ms / floor.ms : 0;
  }
  return json;
}

ordered_json row_json(const Report& report, const SizeReport& size, std::size_t row) {
  const Measurement& m = size.rows[row];
  const FrameStats& s = m.timing.mean;
  ordered_json json = {{"mode", report.modes[row].configuration.name},
                       {"total_ms", s.total_ms},
                       {"eager_clock_ms", m.timing.outside.eager_clock_ms},
                       {"eager_events_ms", m.timing.outside.eager_events_ms},
                       {"queued_ms", m.timing.outside.queued_ms},
                       {"host_us", m.timing.outside.host_us},
                       {"frames", m.timing.frames},
                       {"fastest_camera_ms", m.timing.fastest_ms},
                       {"slowest_camera_ms", m.timing.slowest_ms},
                       {"speedup", speedup(size, row)},
                       {"gaussians", s.gaussians},
                       {"visible", s.visible},
                       {"instances", s.instances},
                       {"evaluated", s.evaluated},
                       {"blended", s.blended},
                       {"key_bits", s.key_bits},
                       {"depth_bits", s.depth_bits},
                       {"depth_resolution", s.depth_resolution},
                       {"bytes", sum(m.costs).bytes},
                       {"peak_bytes", m.timing.peak_bytes}};
  if (!m.timing.drawn.empty()) {
    json["pages"] = s.pages;
    ordered_json drawn = ordered_json::array();
    for (const DrawnLevels& view : m.timing.drawn)
      drawn.push_back({{"camera", view.camera}, {"pages", view.pages}, {"gaussians", view.gaussians}});
    json["drawn"] = std::move(drawn);
  }
  ordered_json stages = ordered_json::object();
  for (std::size_t k = 0; k < kStages.size(); ++k) {
    stages[stage_name(kStages[k])] = cost_json(m.costs[k], stage_ms(s, kStages[k]), report.rates);
  }
  json["stages"] = std::move(stages);
  return json;
}

ordered_json change_json(const Change& c) {
  return {{"mean", c.mean}, {"p999", c.p999}, {"worst_p999", c.worst_p999}, {"largest", c.largest}};
}

ordered_json orbit_json(const OrbitReport& o) {
  ordered_json rows = ordered_json::array();
  for (const OrbitRow& row : o.rows) {
    ordered_json entry = {{"mode", row.mode},
                          {"step", change_json(row.step)},
                          {"second", change_json(row.second)},
                          {"added", change_json(row.added)}};
    const double ratio = unsteadiness(row, o.rows.front());
    entry["unsteadiness"] = std::isfinite(ratio) ? ordered_json(ratio) : ordered_json();
    rows.push_back(std::move(entry));
  }
  return {{"camera", o.camera},   {"width", o.width},       {"height", o.height},        {"frames", o.frames},
          {"degrees", o.degrees}, {"distance", o.distance}, {"results", std::move(rows)}};
}

ordered_json stress_json(const Report& report) {
  ordered_json rows = ordered_json::array();
  bool passed = true;
  for (const SizeReport& size : report.sizes) {
    const StressRow row = stress_row(size, report);
    rows.push_back({{"view", size.view},
                    {"width", size.width},
                    {"height", size.height},
                    {"paper_ms", row.paper_ms},
                    {"turbo_ms", row.turbo_ms},
                    {"ratio", row.ratio()},
                    {"passed", row.passes()}});
    passed = passed && row.passes();
  }
  return {{"scene_size", report.stress->scene_size},
          {"densest", report.stress->dense},
          {"passed", passed},
          {"views", std::move(rows)}};
}

}  // namespace

std::string report_json(const Report& report) {
  ordered_json json;
  json["schema"] = "rgs-bench/2";
  json["version"] = report.version;
  json["date"] = report.date;
  json["device"] = device_json(report.device);
  if (report.rates) json["rates"] = rates_json(*report.rates);
  json["scene"] = {{"name", report.scene},
                   {"source", report.source},
                   {"gaussians", report.gaussians},
                   {"sh_degree", report.sh_degree}};
  if (const auto& l = report.levels) {
    json["scene"]["levels"] = {{"levels", l->n_levels}, {"pages", l->n_pages}, {"gaussians", l->n_stored}};
    json["detail_px"] = l->detail_px;
  }
  json["cameras"] = report.n_cameras;
  json["quality_cameras"] = report.n_quality_cameras;
  json["frames"] = report.frames;
  json["modes"] = ordered_json::array();
  for (const ModeReport& mode : report.modes) {
    ordered_json entry = {{"name", mode.configuration.name},
                          {"step", mode.configuration.step},
                          {"options", options_json(mode.configuration)}};
    if (mode.quality) entry["quality"] = quality_json(*mode.quality);
    json["modes"].push_back(std::move(entry));
  }
  json["sizes"] = ordered_json::array();
  for (const SizeReport& size : report.sizes) {
    ordered_json rows = ordered_json::array();
    for (std::size_t row = 0; row < size.rows.size(); ++row) rows.push_back(row_json(report, size, row));
    ordered_json entry;
    if (!size.view.empty()) entry["view"] = size.view;
    entry["width"] = size.width;
    entry["height"] = size.height;
    entry["results"] = std::move(rows);
    json["sizes"].push_back(std::move(entry));
  }
  if (report.stress) json["stress"] = stress_json(report);
  if (report.orbit) json["orbit"] = orbit_json(*report.orbit);
  // File names need not be UTF-8; JSON must be.
  return json.dump(2, ' ', true, ordered_json::error_handler_t::replace) + "\n";
}

}  // namespace rgs::bench
