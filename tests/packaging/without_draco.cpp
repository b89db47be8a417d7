// without_draco.cpp - a build without Draco reads archives that were written with it, and writes archives:
// without_draco ARCHIVE.rgs
// SPDX-License-Identifier: Apache-2.0
#include <cstdio>
#include <rgs/decode.hpp>
#include <rgs/encode.hpp>
#include <rgs/file.hpp>

namespace {

bool check(bool holds, const char* what) {
  if (!holds) std::fprintf(stderr, "without_draco: not so: %s\n", what);
  return holds;
}

}  // namespace

int main(int argc, char** argv) {
  if (argc != 2) return 2;
  const auto file = rgs::MappedFile::open(argv[1]);
  if (!check(file.has_value(), "the file opens")) return 1;
  const auto cloud = rgs::decode(file->bytes());
  if (!check(cloud && cloud->size() > 0, "it decodes")) return 1;

  rgs::EncodeOptions options;
  bool ok = check(rgs::encode(cloud->view(), options).has_value(), "packed is written");
  options.profile = rgs::Profile::archive;
  const auto archive = rgs::encode(cloud->view(), options);
  if (!check(archive.has_value(), "an archive is written")) return 1;
  const auto again = rgs::decode(*archive);
  ok &= check(again && again->size() == cloud->size(), "it is read");
  return ok ? 0 : 1;
}
