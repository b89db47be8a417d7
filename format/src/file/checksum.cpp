// checksum.cpp - XXH3-64 through the xxHash library.
// SPDX-License-Identifier: Apache-2.0
#include "rgs/checksum.hpp"

#define XXH_STATIC_LINKING_ONLY  // for the size of the state: 576 bytes in the 0.8 releases
#include <xxhash.h>

#include <new>

namespace rgs {
namespace {

static_assert(sizeof(XXH3_state_t) <= sizeof(Hasher));
static_assert(alignof(XXH3_state_t) <= alignof(Hasher));

XXH3_state_t* state_in(std::byte* memory) {
  return std::launder(reinterpret_cast<XXH3_state_t*>(memory));
}

const XXH3_state_t* state_in(const std::byte* memory) {
  return std::launder(reinterpret_cast<const XXH3_state_t*>(memory));
}

}  // namespace

std::uint64_t xxh3(std::span<const std::byte> bytes) {
  return XXH3_64bits(bytes.data(), bytes.size());
}

Hasher::Hasher() {
  XXH3_64bits_reset(new (state_.data()) XXH3_state_t{});
}

void Hasher::update(std::span<const std::byte> bytes) {
  XXH3_64bits_update(state_in(state_.data()), bytes.data(), bytes.size());
}

std::uint64_t Hasher::digest() const {
  return XXH3_64bits_digest(state_in(state_.data()));
}

}  // namespace rgs
