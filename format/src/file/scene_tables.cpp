// scene_tables.cpp - the small sections of a file.
// SPDX-License-Identifier: Apache-2.0
#include "file/scene_tables.hpp"

#include <cassert>
#include <utility>

#include "file/byte_writer.hpp"
#include "file/layout_io.hpp"
#include "packed/packed.hpp"

namespace rgs::detail {
namespace {

std::vector<std::byte> step_sets(const EncodePlan& plan, const SceneTables& tables) {
  ByteWriter out;
  if (plan.options.chunk_step_sets) {
    for (const ShStepSet& set : tables.steps) write_step_set(out, set);
  } else if (!tables.chunks.empty()) {
    write_step_set(out, plan.file_steps);
  }
  return out.take();
}

std::vector<std::byte> chunk_table(const EncodePlan& plan, const SceneTables& tables) {
  ByteWriter out;
  for (std::size_t i = 0; i < tables.chunks.size(); ++i) {
    ChunkEntry chunk = tables.chunks[i];
    chunk.step_set = plan.options.chunk_step_sets ? i : 0;
    write_chunk_entry(out, chunk);
  }
  return out.take();
}

}  // namespace

Result<WrittenScene> finish_file(SectionWriter& file, const EncodePlan& plan, const SceneTables& tables) {
  assert(tables.chunks.size() == plan.header.n_chunks && tables.steps.size() == tables.chunks.size());
  WrittenScene written{plan.header, plan.declarations, {}};
  tables.counts.declare(written.declarations);
  const auto place_table = [&](SectionType type, std::vector<std::byte> records) {
    if (plan.options.profile == Profile::direct) return file.place(type, records, Codec::none);
    const StoredTable stored = code_table(std::move(records), plan.options.level);
    return file.place(type, stored.bytes, stored.codec);
  };
  for (const SectionEntry& entry : plan.sections) {
    const auto type = static_cast<SectionType>(entry.type);
    Status placed;
    switch (type) {
      case SectionType::declarations:
        placed = file.place(type, write_declarations(written.declarations), Codec::none);
        break;
      case SectionType::sh_steps: placed = place_table(type, step_sets(plan, tables)); break;
      case SectionType::chunks: placed = place_table(type, chunk_table(plan, tables)); break;
      case SectionType::means:
      case SectionType::geometry:
      case SectionType::sh: placed = file.place_grown(type, plan.frame_rows()); break;
      case SectionType::archive: placed = file.place(type, tables.archive, Codec::none); break;
      case SectionType::permutation: placed = file.place(type, std::as_bytes(tables.source_index), Codec::none); break;
      case SectionType::provenance:
        placed = file.place(type, write_provenance(*plan.options.provenance), Codec::none);
        break;
    }
    if (!placed) return tl::unexpected(placed.error());
  }
  auto sections = file.finish(written.header);
  if (!sections) return tl::unexpected(sections.error());
  written.sections = std::move(*sections);
  return written;
}

}  // namespace rgs::detail
