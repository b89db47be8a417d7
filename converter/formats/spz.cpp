// spz.cpp - Niantic's .spz: six arrays of codes, in one gzip stream (versions 2, 3) or in a zstd stream each (4). Where
// they are: spz_header.cpp; what they mean: spz_codes.cpp.
// SPDX-License-Identifier: Apache-2.0
#include "spz.hpp"

#include <zlib.h>
#include <zstd.h>

#include <array>
#include <cmath>
#include <cstdio>
#include <functional>
#include <future>
#include <memory>
#include <optional>
#include <utility>

#include "morton_order.hpp"
#include "quantised.hpp"
#include "rgs/encode.hpp"
#include "rgs/quantize.hpp"
#include "spz_codes.hpp"
#include "spz_georeference.hpp"
#include "spz_header.hpp"

namespace rgs::detail {
namespace {

constexpr std::size_t kShStream = 5;

struct SpzContent {
  SpzHeader header;
  std::vector<std::byte> body;  // the streams, one after the other
  SpzExtensions extensions;
  std::vector<std::byte> records;  // of the extensions
};

std::string unused_text(const SpzExtensions::Record& record) {
  char text[96];
  std::snprintf(text, sizeof text, "SPZ extension 0x%08X (%s, %llu bytes)", record.type, record.name,
                static_cast<unsigned long long>(record.bytes));
  return text;
}

// ---- gzip -----------------------------------------------------------------------------------------------------------

class Inflater {
 public:
  static std::optional<Inflater> begin(std::span<const std::byte> bytes) {
    Inflater z;
    z.stream_ = std::make_unique<z_stream>();
    constexpr int kGzipOnly = 15 + 16;
    if (inflateInit2(z.stream_.get(), kGzipOnly) != Z_OK) return std::nullopt;
    z.bytes_ = bytes;
    return z;
  }
  Inflater(Inflater&&) = default;
  Inflater& operator=(Inflater&&) = delete;
  ~Inflater() {
    if (stream_ != nullptr) inflateEnd(stream_.get());
  }

  /// Fills `out`. Errors: truncated, bad_value (not a deflate stream), checksum_mismatch.
  Status read(std::span<std::byte> out) {
    while (!out.empty()) {
      const auto got = some(out);
      if (!got) return tl::unexpected(got.error());
      if (*got == 0) return make_error(Errc::truncated, consumed_, "the compressed data end early");
      out = out.subspan(*got);
    }
    return {};
  }
  /// The rest of the stream. Errors: those of read(); limit_exceeded beyond kSpzMostExtensionBytes.
  Result<std::vector<std::byte>> rest() {
    std::vector<std::byte> out;
    for (std::array<std::byte, 4096> piece{};;) {
      const auto got = some(piece);
      if (!got) return tl::unexpected(got.error());
      if (*got == 0) return out;
      if (out.size() + *got > kSpzMostExtensionBytes) {
        return make_error(Errc::limit_exceeded, consumed_, "more bytes of extensions than any file needs",
                          kSpzMostExtensionBytes);
      }
      out.insert(out.end(), piece.begin(), piece.begin() + static_cast<std::ptrdiff_t>(*got));
    }
  }
  /// Checks that the stream ends here, with its checksum.
  Status finish() {
    std::byte extra{};
    const auto got = some({&extra, 1});
    if (!got) return tl::unexpected(got.error());
    if (*got != 0)
      return make_error(Errc::trailing_bytes, consumed_, "the compressed data hold more than the header says");
    if (consumed_ != bytes_.size())
      return make_error(Errc::trailing_bytes, consumed_, "bytes after the compressed data");
    return {};
  }

 private:
  Inflater() = default;
  // Fills some of `out`, which is not empty; 0 only at the end of the stream.
  Result<std::size_t> some(std::span<std::byte> out) {
    constexpr std::size_t kPiece = std::size_t{1} << 30;  // zlib counts in 32 bits
    while (!ended_) {
      const std::span<const std::byte> rest = bytes_.subspan(consumed_);
      stream_->next_in = reinterpret_cast<Bytef*>(const_cast<std::byte*>(rest.data()));  // zlib does not write there
      stream_->avail_in = static_cast<uInt>(std::min(rest.size(), kPiece));
      stream_->next_out = reinterpret_cast<Bytef*>(out.data());
      stream_->avail_out = static_cast<uInt>(std::min(out.size(), kPiece));
      const uInt had_in = stream_->avail_in, had_out = stream_->avail_out;
      const int code = inflate(stream_.get(), Z_NO_FLUSH);
      consumed_ += had_in - stream_->avail_in;
      ended_ = code == Z_STREAM_END;
      if (code == Z_MEM_ERROR) throw std::bad_alloc();
      if (code != Z_OK && code != Z_STREAM_END && code != Z_BUF_ERROR) {
        const bool sum = stream_->msg != nullptr && std::strstr(stream_->msg, "data check") != nullptr;
        if (sum) return make_error(Errc::checksum_mismatch, consumed_, "the compressed data fail their checksum");
        return make_error(Errc::bad_value, consumed_, "the compressed data are damaged");
      }
      if (stream_->avail_out != had_out) return had_out - stream_->avail_out;
      if (!ended_ && consumed_ == bytes_.size()) break;
    }
    if (ended_) return 0;
    return make_error(Errc::truncated, consumed_, "the compressed data end early");
  }

  std::unique_ptr<z_stream> stream_;  // zlib keeps a pointer back to it
  std::span<const std::byte> bytes_;
  std::uint64_t consumed_ = 0;
  bool ended_ = false;
};

bool is_gzip(std::span<const std::byte> bytes) {
  return bytes.size() >= 2 && load<std::uint16_t>(bytes, 0) == 0x8B1F;
}

Result<SpzContent> unpack_gzip(std::span<const std::byte> bytes, const ReadOptions& options) {
  auto inflater = Inflater::begin(bytes);
  if (!inflater) throw std::bad_alloc();
  std::array<std::byte, kSpzHeaderBytes> head{};
  if (const Status s = inflater->read(head); !s) return tl::unexpected(s.error());
  const auto header = parse_spz_header(head, options.limits, bytes.size(), true);
  if (!header) return tl::unexpected(header.error());
  SpzContent content{*header, std::vector<std::byte>(header->decoded_bytes()), {}, {}};
  if (const Status s = inflater->read(content.body); !s) return tl::unexpected(s.error());
  if (header->has_extensions()) {
    auto rest = inflater->rest();
    if (!rest) return tl::unexpected(rest.error());
    content.records = std::move(*rest);
  }
  if (const Status s = inflater->finish(); !s) return tl::unexpected(s.error());
  auto extensions =
      parse_spz_extensions(content.records, kSpzHeaderBytes + content.body.size(), options.skip_unknown_extensions);
  if (!extensions) return tl::unexpected(extensions.error());
  content.extensions = std::move(*extensions);
  return content;
}

// ---- zstd -----------------------------------------------------------------------------------------------------------

Result<SpzContent> unpack_zstd(std::span<const std::byte> bytes, const ReadOptions& options) {
  auto layout = spz_layout(bytes, options.limits, bytes.size(), false, options.skip_unknown_extensions);
  if (!layout) return tl::unexpected(layout.error());
  SpzContent content{
      layout->header, std::vector<std::byte>(layout->header.decoded_bytes()), std::move(layout->extensions), {}};
  const auto records = bytes.first(layout->streams.front().offset).subspan(kSpzHeaderBytesV4);
  content.records.assign(records.begin(), records.end());
  std::uint64_t to = 0;
  for (const auto& [offset, stored, decoded] : layout->streams) {
    const std::size_t got =
        decoded == 0 ? 0 : ZSTD_decompress(content.body.data() + to, decoded, bytes.data() + offset, stored);
    if (ZSTD_isError(got) != 0 || got != decoded) {
      return make_error(Errc::bad_value, offset, "a zstd stream is damaged", decoded,
                        ZSTD_isError(got) != 0 ? Error::kNone : static_cast<std::uint64_t>(got));
    }
    to += decoded;
  }
  return content;
}

// ---- codes ----------------------------------------------------------------------------------------------------------

std::uint32_t encode_rotation(const float (&rotation)[4]) {
  const SmallestThree s = smallest_three({rotation[1], rotation[2], rotation[3], rotation[0]});
  std::uint32_t code = s.largest;
  for (const double value : s.rest) {
    const std::uint32_t magnitude = unit_code(std::abs(value) / kRootHalf, kSpzMagnitudeMax);
    code = code << 10 | (value < 0 && magnitude != 0 ? 512u : 0u) | magnitude;
  }
  return code;
}

// Version 2 keeps x, y and z of a quaternion whose w is not negative. A small w takes all their errors, so this tries
// the codes above and below each component and takes those that decode nearest to the rotation: for random ones 0.016
// rad (RMS), 0.12 at worst, instead of 0.030 and 0.21 by rounding.
void encode_rotation_v2(const float (&rotation)[4], std::span<std::byte> code) {
  double unit[4], squared = 0;
  for (const float value : rotation) squared += static_cast<double>(value) * static_cast<double>(value);
  const double factor = squared > 0 ? (rotation[0] < 0 ? -1 : 1) / std::sqrt(squared) : 0;
  for (unsigned i = 0; i < 4; ++i) unit[i] = static_cast<double>(rotation[i]) * factor;
  double nearest = -1;
  for (unsigned choice = 0; choice < 8; ++choice) {
    std::array<std::byte, 3> tried;
    for (unsigned i = 0; i < 3; ++i) {
      const double below = std::floor((unit[i + 1] + 1) * 127.5);
      tried[i] = static_cast<std::byte>(std::min(static_cast<int>(below) + static_cast<int>(choice >> i & 1), 255));
    }
    float decoded[4];
    decode_spz_rotation_v2(tried, decoded);
    double dot = 0, length = 0;
    for (unsigned i = 0; i < 4; ++i) {
      dot += unit[i] * static_cast<double>(decoded[i]);
      length += static_cast<double>(decoded[i]) * static_cast<double>(decoded[i]);
    }
    if (const double cosine = std::abs(dot) / std::sqrt(length); cosine > nearest) {
      nearest = cosine;
      std::ranges::copy(tried, code.begin());
    }
  }
}

// SH codes are 128 + 128 * value, of which the encoder keeps the upper bits, so that they compress. Most codes are 0,
// and since a pixel blends neighbours, errors of one sign would add up. So each code takes over some of the error of
// those before it in space (error diffusion; Floyd and Steinberg 1976). An outdoor scene of 778,812 Gaussians gains 1.2
// dB for 0.7 bytes; with a share of a half 2.4 dB for 2.3. Decoded SPZ values have no error to pass on.
class ShDiffusion {
 public:
  explicit ShDiffusion(std::uint64_t floats) : carry_(floats) {}

  // `sh` and `codes`: the coefficients above degree 0 of the next Gaussian.
  void encode(const float* sh, std::byte* codes) {
    for (std::size_t k = 0; k < carry_.size(); ++k) {
      const double step = k < 9 ? 8 : 16, value = static_cast<double>(sh[k]) * 128;
      const double wanted = value + kShare * std::clamp(carry_[k], -step, step);
      const double code = std::clamp(step * std::floor(wanted / step + 0.5), -128.0, 127.0);
      carry_[k] = kMemory * (carry_[k] + value - code);
      codes[k] = static_cast<std::byte>(static_cast<int>(code) + 128);
    }
  }

 private:
  static constexpr double kShare = 0.12, kMemory = 0.97;
  std::vector<double> carry_;
};

using CodedStreams = std::array<std::vector<std::byte>, kSpzStreams>;

CodedStreams encode_streams(const SplatView& splats, const SpzHeader& header) {
  CodedStreams out;
  const auto sizes = header.sizes();
  for (std::size_t i = 0; i < kSpzStreams; ++i) out[i].resize(sizes[i]);
  for (std::uint64_t i = 0; i < 3 * splats.n; ++i) {
    const double fixed = std::floor(std::ldexp(static_cast<double>(splats.mean[i]), header.fractional_bits) + 0.5);
    const auto code = static_cast<std::uint32_t>(static_cast<std::int32_t>(fixed));
    for (unsigned b = 0; b < 3; ++b) out[0][3 * i + b] = static_cast<std::byte>(code >> 8 * b & 255);
    out[3][i] = static_cast<std::byte>(unit_code((static_cast<double>(splats.log_scale[i]) + 10) * 16 / 255, 255));
  }
  const auto floats = static_cast<std::uint64_t>(3 * sh_coefficients(header.sh_degree));
  for (std::uint64_t i = 0; i < splats.n; ++i) {
    out[1][i] = static_cast<std::byte>(unit_code(opacity_from_logit(splats.opacity_logit[i]), 255));
    const float* sh = &splats.sh[floats * i];
    for (std::uint64_t c = 0; c < 3; ++c) {
      out[2][3 * i + c] = static_cast<std::byte>(unit_code(static_cast<double>(sh[c]) * kSpzColourScale + 0.5, 255));
    }
    const float* q = &splats.rotation[4 * i];
    if (header.version == 2) {
      encode_rotation_v2({q[0], q[1], q[2], q[3]}, std::span(out[4]).subspan(3 * i, 3));
    } else {
      store(std::span(out[4]), 4 * i, encode_rotation({q[0], q[1], q[2], q[3]}));
    }
  }
  if (header.sh_degree == 0) return out;
  ShDiffusion diffusion(floats - 3);
  for (const std::size_t i : morton_order(splats)) {
    diffusion.encode(&splats.sh[floats * i + 3], &out[5][(floats - 3) * i]);
  }
  return out;
}

// A frame within readers' limits on expansion: a block takes at least four bytes, and there is one for every 2048. For
// scenes of equal Gaussians.
std::vector<std::byte> compress_in_blocks(const std::vector<std::byte>& stream) {
  const std::unique_ptr<ZSTD_CCtx, decltype(&ZSTD_freeCCtx)> context(ZSTD_createCCtx(), ZSTD_freeCCtx);
  if (context == nullptr) throw std::bad_alloc();
  constexpr std::size_t kBlock = 2048;
  std::vector<std::byte> stored(ZSTD_compressBound(stream.size()) + 16 * (stream.size() / kBlock) + 64);
  ZSTD_CCtx_setPledgedSrcSize(context.get(), stream.size());
  ZSTD_outBuffer target{stored.data(), stored.size(), 0};
  for (std::size_t at = 0; at < stream.size(); at += kBlock) {
    const std::size_t n = std::min(kBlock, stream.size() - at);
    ZSTD_inBuffer block{stream.data() + at, n, 0};
    const ZSTD_EndDirective directive = at + n == stream.size() ? ZSTD_e_end : ZSTD_e_flush;
    if (ZSTD_isError(ZSTD_compressStream2(context.get(), &target, &block, directive)) != 0) throw std::bad_alloc();
  }
  stored.resize(target.pos);
  return stored;
}

// One zstd frame. Optimal parsing with few tries suits short matches and entropy: an outdoor scene takes 20.9 bytes a
// Gaussian and 11 s of CPU time; level 12, which parses lazily, 21.8 and 2.7 s.
std::vector<std::byte> compress_zstd(const std::vector<std::byte>& stream, std::size_t index) {
  const std::unique_ptr<ZSTD_CCtx, decltype(&ZSTD_freeCCtx)> context(ZSTD_createCCtx(), ZSTD_freeCCtx);
  std::vector<std::byte> stored(ZSTD_compressBound(stream.size()));
  if (context == nullptr) throw std::bad_alloc();
  const std::pair<ZSTD_cParameter, int> parameters[] = {
      {ZSTD_c_strategy, ZSTD_btopt}, {ZSTD_c_windowLog, 22}, {ZSTD_c_chainLog, 22},
      {ZSTD_c_hashLog, 20},          {ZSTD_c_searchLog, 3},  {ZSTD_c_minMatch, index == kShStream ? 5 : 3},
      {ZSTD_c_targetLength, 32}};
  for (const auto& [parameter, value] : parameters) ZSTD_CCtx_setParameter(context.get(), parameter, value);
  const std::size_t size = ZSTD_compress2(context.get(), stored.data(), stored.size(), stream.data(), stream.size());
  if (ZSTD_isError(size) != 0) throw std::bad_alloc();  // the only failure possible with a buffer of the bound
  stored.resize(size);
  if (stored.size() <= stream.size() / 1024) return compress_in_blocks(stream);
  return stored;
}

// Compresses one stream as a byte-aligned part of a DEFLATE stream that refers to nothing before it, so that streams
// are compressed in parallel. Only SH needs a long search: 6.45 bytes a Gaussian of the scene above in 9.5 s; zlib's
// level 6 takes 6.9 and 2 s, level 9 6.3 and 28 s.
std::vector<std::byte> compress_deflate(const std::vector<std::byte>& stream, std::size_t index) {
  constexpr int kRaw = -15, kMemory = 8;
  z_stream z{};
  if (deflateInit2(&z, Z_BEST_COMPRESSION, Z_DEFLATED, kRaw, kMemory, Z_DEFAULT_STRATEGY) != Z_OK)
    throw std::bad_alloc();
  const std::unique_ptr<z_stream, decltype(&deflateEnd)> guard(&z, deflateEnd);
  if (index == kShStream) deflateTune(&z, 16, 64, 258, 1024);
  constexpr std::size_t kPiece = std::size_t{1} << 20;
  std::vector<std::byte> stored, out(kPiece);
  std::size_t done = 0;
  do {  // zlib counts in 32 bits
    const std::size_t piece = std::min(kPiece, stream.size() - done);
    z.next_in = reinterpret_cast<Bytef*>(const_cast<std::byte*>(stream.data() + done));  // zlib does not write there
    z.avail_in = static_cast<uInt>(piece);
    done += piece;
    do {
      z.next_out = reinterpret_cast<Bytef*>(out.data());
      z.avail_out = static_cast<uInt>(kPiece);
      deflate(&z, done == stream.size() ? Z_SYNC_FLUSH : Z_NO_FLUSH);
      stored.insert(stored.end(), out.begin(), out.begin() + static_cast<std::ptrdiff_t>(kPiece - z.avail_out));
    } while (z.avail_out == 0);
  } while (done < stream.size());
  return stored;
}

template <class Compress>
CodedStreams compress_all(const CodedStreams& streams, Compress compress) {
  std::array<std::future<std::vector<std::byte>>, kSpzStreams> compressed;
  for (std::size_t i = kSpzStreams; i-- > 0;) {  // SH, which takes longest, first
    compressed[i] = std::async(std::launch::async | std::launch::deferred, compress, std::cref(streams[i]), i);
  }
  CodedStreams out;
  for (std::size_t i = 0; i < kSpzStreams; ++i) out[i] = compressed[i].get();
  return out;
}

void store_shared_header(std::span<std::byte> file, const SpzHeader& header) {
  store(file, 0, kSpzMagic);
  store(file, 4, header.version);
  store(file, 8, header.n);
  store(file, 12, header.sh_degree);
  store(file, 13, header.fractional_bits);
  store(file, 14, header.flags);
}

std::vector<std::byte> pack_zstd(const SpzHeader& header, std::span<const std::byte> records,
                                 const CodedStreams& streams) {
  const std::uint64_t table = kSpzHeaderBytesV4 + records.size();
  std::vector<std::byte> file(table + 16 * header.n_streams());
  std::ranges::copy(records, file.begin() + kSpzHeaderBytesV4);
  store_shared_header(file, header);
  store(std::span(file), 15, static_cast<std::uint8_t>(header.n_streams()));
  store(std::span(file), 16, static_cast<std::uint32_t>(table));
  const CodedStreams compressed = compress_all(streams, compress_zstd);
  std::uint64_t entry = table;
  for (std::size_t i = 0; i < header.n_streams(); ++i, entry += 16) {
    store(std::span(file), entry, static_cast<std::uint64_t>(compressed[i].size()));
    store(std::span(file), entry + 8, static_cast<std::uint64_t>(streams[i].size()));
    file.insert(file.end(), compressed[i].begin(), compressed[i].end());
  }
  return file;
}

// RFC 1952 without name and time, system unknown: the same bytes on any machine.
std::vector<std::byte> pack_gzip(const SpzHeader& header, CodedStreams streams) {
  constexpr std::array<std::uint8_t, 10> kHead{0x1F, 0x8B, 8, 0, 0, 0, 0, 0, 2, 255};
  constexpr std::array<std::uint8_t, 2> kEmptyLastBlock{3, 0};
  std::array<std::byte, kSpzHeaderBytes> head{};
  store_shared_header(head, header);
  streams[0].insert(streams[0].begin(), head.begin(), head.end());
  uLong crc = crc32_z(0, nullptr, 0);
  std::uint64_t size = 0;
  for (const auto& stream : streams) {
    if (stream.empty()) continue;  // zlib would restart its checksum
    crc = crc32_z(crc, reinterpret_cast<const Bytef*>(stream.data()), stream.size());
    size += stream.size();
  }
  std::vector<std::byte> file;
  const auto append = [&file](std::span<const std::byte> bytes) {
    file.insert(file.end(), bytes.begin(), bytes.end());
  };
  append(std::as_bytes(std::span(kHead)));
  for (const auto& part : compress_all(streams, compress_deflate)) append(part);
  append(std::as_bytes(std::span(kEmptyLastBlock)));
  const std::array<std::uint32_t, 2> tail{static_cast<std::uint32_t>(crc), static_cast<std::uint32_t>(size)};
  append(std::as_bytes(std::span(tail)));
  return file;
}

}  // namespace

Result<int> choose_fractional_bits(const SplatView& splats) {
  int bits = kSpzFractionalBits;
  for (std::uint64_t i = 0; i < splats.mean.size(); ++i) {
    const double magnitude = std::abs(static_cast<double>(splats.mean[i]));
    while (bits >= 0 && std::floor(std::ldexp(magnitude, bits) + 0.5) > 8388607) --bits;
    if (bits < 0)
      return make_error(Errc::bad_value, i / 3,
                        "the mean of the Gaussian of this index is beyond SPZ's range of 2^23 units");
  }
  return bits;
}

bool is_spz(std::span<const std::byte> bytes) {
  if (!is_gzip(bytes)) return bytes.size() >= 4 && load<std::uint32_t>(bytes, 0) == kSpzMagic;
  auto inflater = Inflater::begin(bytes);
  std::array<std::byte, 4> magic{};
  return inflater && inflater->read(magic) && load<std::uint32_t>(magic, 0) == kSpzMagic;
}

Result<SplatFile> decode_spz(std::span<const std::byte> bytes, const ReadOptions& options, bool placed) {
  const auto content = is_gzip(bytes) ? unpack_gzip(bytes, options) : unpack_zstd(bytes, options);
  if (!content) return tl::unexpected(content.error());
  const SpzExtensions& extensions = content->extensions;
  const SpzHeader& header = content->header;
  SpzStreams streams;
  std::uint64_t at = 0;
  const auto sizes = header.sizes();
  for (std::size_t i = 0; i < kSpzStreams; at += sizes[i++])
    streams[i] = std::span(content->body).subspan(at, sizes[i]);
  SplatFile file;
  file.format = SplatFormat::spz;
  file.bytes = bytes.size();
  file.axes = extensions.axes.value_or(options.spz_axes);
  file.axes_assumed = !extensions.axes;
  file.aa_mode = header.is_antialiased() ? AaMode::mip_splatting : AaMode::classic;
  file.cloud = decode_spz_streams(header, streams);
  for (const auto& record : extensions.unused) {
    const auto payload = std::span(content->records).subspan(record.at, record.bytes);
    const bool applied = placed && record.type == kSpzGeoreference && apply_georeference(payload, file);
    if (applied) placed = false;  // once
    if (!applied) file.unused.push_back(unused_text(record));
  }
  return file;
}

Result<std::vector<std::byte>> encode_spz(const SplatView& splats, const WriteOptions& options) {
  const int version = options.spz_version;
  if (version < 2 || version > 4)
    return make_error(Errc::bad_argument, Error::kNone, "SPZ is written in version 2, 3 or 4");
  const auto fractional_bits = choose_fractional_bits(splats);
  if (!fractional_bits) return tl::unexpected(fractional_bits.error());
  SpzHeader header;
  header.version = static_cast<std::uint32_t>(version);
  header.n = static_cast<std::uint32_t>(splats.n);
  header.sh_degree = static_cast<std::uint8_t>(splats.sh_degree);
  header.fractional_bits = static_cast<std::uint8_t>(*fractional_bits);
  const std::vector<std::byte> records = georeference_records(options);
  header.flags = static_cast<std::uint8_t>((options.aa_mode == AaMode::mip_splatting ? kSpzAntialiased : 0) |
                                           (records.empty() ? 0 : kSpzHasExtensions));
  const CodedStreams streams = encode_streams(splats, header);
  return version < 4 ? pack_gzip(header, streams) : pack_zstd(header, records, streams);
}

}  // namespace rgs::detail
