// pages.cpp - the scheduler of pages for JavaScript; src/pages.ts calls it. docs/develop/PAGES.md.
// SPDX-License-Identifier: Apache-2.0
#include <cstdint>
#include <span>

#include "pages/wire.hpp"

#define RGS_EXPORT(name) extern "C" [[clang::export_name(#name)]]

namespace {

using rgs::pages::Wire;

std::span<const double> actions;

}  // namespace

RGS_EXPORT(rgs_pages_new)
Wire* rgs_pages_new(const double* setup, std::uint32_t n_setup, const double* pages, std::uint32_t n_pages) {
  return new Wire({setup, n_setup}, {pages, n_pages});
}
RGS_EXPORT(rgs_pages_add_view) std::uint32_t rgs_pages_add_view(Wire* wire) {
  return wire->add_view();
}
/// Returns the count of numbers of the actions, which are at rgs_pages_actions().
RGS_EXPORT(rgs_pages_step)
std::uint32_t rgs_pages_step(Wire* wire, const double* events, std::uint32_t n, double now) {
  actions = wire->step({events, n}, now);
  return actions.size();
}
RGS_EXPORT(rgs_pages_actions) const double* rgs_pages_actions() {
  return actions.data();
}
RGS_EXPORT(rgs_pages_error_px) double rgs_pages_error_px(Wire* wire, std::uint32_t view, std::uint32_t page) {
  return wire->error_px(view, page);
}
RGS_EXPORT(rgs_pages_wanted) double rgs_pages_wanted(Wire* wire, std::uint32_t view) {
  return wire->n_wanted(view);
}
RGS_EXPORT(rgs_pages_quarantined) std::uint32_t rgs_pages_quarantined(Wire* wire) {
  return wire->n_quarantined();
}
