// errors.ts - the one error type, with the codes of the C++ library (rgs/result.hpp, errc_name()).
// SPDX-License-Identifier: Apache-2.0

/** What went wrong. Those from `truncated` to `corrupt_data` speak of the file, the others of what is around it. */
export type RgsErrorCode =
  | "internal"
  | "cancelled"
  | "bad_argument"
  | "unavailable"
  | "open_failed"
  | "read_failed"
  | "host_out_of_memory"
  | "truncated"
  | "bad_magic"
  | "unsupported_version"
  | "reserved_bits"
  | "bad_header"
  | "bad_section"
  | "section_overlap"
  | "section_gap"
  | "trailing_bytes"
  | "checksum_mismatch"
  | "missing_section"
  | "duplicate_section"
  | "unknown_required"
  | "unsupported_codec"
  | "size_mismatch"
  | "limit_exceeded"
  | "bad_value"
  | "unsupported_feature"
  | "corrupt_data"
  | "pages_missing";

export interface RgsErrorFields {
  code: RgsErrorCode;
  /** What is wrong and, where it helps, what to do. */
  text: string;
  /** Byte of the file at which it was noticed. */
  offset?: number | undefined;
  /** What should have been there: a count, a size, a checksum. */
  expected?: bigint | undefined;
  /** What was there. */
  found?: bigint | undefined;
}

export class RgsError extends Error implements RgsErrorFields {
  override readonly name = "RgsError";
  readonly code: RgsErrorCode;
  readonly text: string;
  readonly offset: number | undefined;
  readonly expected: bigint | undefined;
  readonly found: bigint | undefined;

  constructor(fields: RgsErrorFields, options?: ErrorOptions) {
    const { code, text, offset, expected, found } = fields;
    const notes: string[] = [];
    if (offset !== undefined) notes.push(`at byte ${offset}`);
    if (expected !== undefined) notes.push(`expected ${expected}`);
    if (found !== undefined) notes.push(`found ${found}`);
    super(`${code}: ${text}${notes.length > 0 ? ` (${notes.join(", ")})` : ""}`, options);
    this.code = code;
    this.text = text;
    this.offset = offset;
    this.expected = expected;
    this.found = found;
  }

  /** What survives a message between threads, which turns a class into a plain Error. */
  get fields(): RgsErrorFields {
    return { code: this.code, text: this.text, offset: this.offset, expected: this.expected, found: this.found };
  }
}
