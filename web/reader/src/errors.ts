// errors.ts - the one error type, with the codes of the C++ library (rgs/result.hpp, errc_name()).
// SPDX-License-Identifier: Apache-2.0

/** Codes from `truncated` to `corrupt_data` mean that the file is at fault. */
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
  | "bad_syntax"
  | "not_gaussian_splats"
  | "unsupported_feature"
  | "too_many_bad"
  | "corrupt_data"
  | "pages_missing";

/** What an RgsError says. */
export interface RgsErrorFields {
  code: RgsErrorCode;
  /** What is wrong and, where it helps, what to do. */
  text: string;
  /** The byte of the file where the error was found. */
  offset?: number | undefined;
  /** The expected count, size or checksum. */
  expected?: bigint | undefined;
  /** The one found instead. */
  found?: bigint | undefined;
}

export function outOfMemory(): RgsError {
  return new RgsError({
    code: "host_out_of_memory",
    text: "this file does not fit into memory; a file with levels of detail can be read page by page",
  });
}

/** Typed arrays, or host_out_of_memory. */
export function allocate<T>(make: () => T): T {
  try {
    return make();
  } catch (error) {
    if (error instanceof RangeError) throw outOfMemory();
    throw error;
  }
}

/** Every error of a file, a source or memory; an aborted call rejects with its signal's reason instead. */
export class RgsError extends Error implements RgsErrorFields {
  override readonly name = "RgsError";
  /** Stable; the text is not. */
  readonly code: RgsErrorCode;
  readonly text: string;
  readonly offset: number | undefined;
  readonly expected: bigint | undefined;
  readonly found: bigint | undefined;

  /** For sources of your own. */
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

  /** All of them, for messages between threads, which do not keep the class. */
  get fields(): RgsErrorFields {
    return { code: this.code, text: this.text, offset: this.offset, expected: this.expected, found: this.found };
  }
}
