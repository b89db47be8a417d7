#!/usr/bin/env node
// cli.ts - npx @roofgs/convert INPUT.ply OUTPUT.rgs, for machines without rgs-convert: its names of options, messages and exit codes.
// SPDX-License-Identifier: Apache-2.0
import { constants, unlinkSync } from "node:fs";
import { copyFile, link, open, readFile, rename, stat, unlink } from "node:fs/promises";
import { basename, dirname, resolve } from "node:path";
import { parseArgs } from "node:util";
import { kMostSource, kProfiles, type Profile } from "./conversion.js";
import { convert, RgsError, type Report } from "./node.js";

const kProgram = "rgs-convert";
const kHelp = `Converts a PLY file of 3D Gaussian splats to .rgs.

Usage: npx @roofgs/convert [OPTIONS] INPUT.ply OUTPUT.rgs

  --profile PROFILE  ${kProfiles.join(", ")} [packed]
  --lod              Add levels of detail
  --overwrite        Replace an existing output
  --quiet, -q        No summary
  --help, -h         This text

Exit codes: 0 ok, 1 internal error, 2 usage, 3 input/output, 4 malformed input.
The native rgs-convert reads other formats, has more options and is faster.
`;
/** Codes of the machine, not of the file. */
const kMachine: readonly string[] = ["open_failed", "read_failed", "write_failed", "output_exists", "output_unusable", "host_out_of_memory", "unavailable"];

const kStops = ["SIGINT", "SIGTERM"] as const;

/** Text and exit code of what ends the program. */
class End extends Error {
  constructor(
    message: string,
    readonly exitCode: number,
  ) {
    super(message);
  }
}

const usage = (message: string): End => new End(`${message}\nRun npx @roofgs/convert --help for usage.`, 2);

/** Of an error of Node. */
function systemError(file: string, what: string, code: string, error: unknown): End {
  return new End(`${file}: ${what}: ${String((error as Error).message)} [${code}]`, 3);
}

interface Arguments {
  input: string;
  output: string;
  profile: Profile;
  lod: boolean;
  overwrite: boolean;
  quiet: boolean;
}

function parse(): Arguments | null {
  const flag = { type: "boolean", default: false } as const;
  const options = { profile: { type: "string", default: "packed" }, lod: flag, overwrite: flag, quiet: { ...flag, short: "q" }, help: { ...flag, short: "h" } } as const;
  const { values, positionals } = (() => {
    try {
      return parseArgs({ options, allowPositionals: true });
    } catch (error) {
      throw usage((error as Error).message);
    }
  })();
  if (values.help) return null;
  const [input, output] = positionals;
  if (input === undefined || output === undefined || positionals.length > 2) throw usage("an input and an output are needed");
  const profile = kProfiles.find((name) => name === values.profile);
  if (!profile) throw usage(`--profile: ${values.profile} is none of ${kProfiles.join(", ")}`);
  if (!/\.rgs$/i.test(output)) throw usage(`${output}: this program writes .rgs alone`);
  return { ...values, input, output, profile };
}

async function refuse(input: string, output: string, overwrite: boolean): Promise<void> {
  const [source, found] = await Promise.all([input, output].map((path) => stat(path).catch(() => undefined)));
  if (found && found.ino === source?.ino && found.dev === source.dev) throw usage(`${output}: it is the input`);
  if (source && source.size > kMostSource) throw new End(`${input}: a PLY of 2 GiB or more does not fit into the memory here; convert it with the native rgs-convert [host_out_of_memory]`, 3);
  if (found && !found.isFile()) throw new End(`${output}: it is no file [output_unusable]`, 3);
  if (found && !overwrite) throw new End(`${output}: it exists; --overwrite replaces it [output_exists]`, 3);
}

/** Where the file system has no links, a copy is not made where there is a file either. */
async function place(temporary: string, output: string): Promise<void> {
  await link(temporary, output).catch((error: unknown) => {
    if (!["EPERM", "ENOTSUP", "EOPNOTSUPP", "ENOSYS"].includes((error as { code: string }).code)) throw error;
    return copyFile(temporary, output, constants.COPYFILE_EXCL);
  });
}

/** Writes all, or leaves the output as it was. */
async function write(output: string, blob: Blob, overwrite: boolean): Promise<void> {
  const temporary = `${output}.${process.pid}.tmp`;
  const file = await open(temporary, "wx");
  const stop = (signal: NodeJS.Signals): void => {
    unlinkSync(temporary);
    process.kill(process.pid, signal);
  };
  for (const signal of kStops) process.once(signal, stop);
  try {
    try {
      await file.writeFile(new Uint8Array(await blob.arrayBuffer()));
      await file.sync();
    } finally {
      await file.close();
    }
    // A link is not made where there is a file by now.
    await (overwrite ? rename(temporary, output) : place(temporary, output));
    const folder = await open(dirname(resolve(output)), "r").catch(() => undefined);
    // Windows has no such thing.
    await folder?.sync().catch(() => undefined);
    await folder?.close();
  } finally {
    for (const signal of kStops) process.off(signal, stop);
    await unlink(temporary).catch(() => undefined);
  }
}

function summary(output: string, { bytes, nSource, nWritten, nRepaired, shDegree, nLevels, sourceBytes }: Report): string {
  const dropped = nSource - nWritten;
  const damage = [dropped > 0 && `${dropped} dropped`, nRepaired > 0 && `${nRepaired} repaired`].filter((text) => text);
  const levels = nLevels > 0 ? `, ${nLevels} levels` : "";
  return `${output}: ${nWritten} Gaussians of degree ${shDegree}${levels}, ${bytes} bytes of ${sourceBytes}${damage.length > 0 ? ` (damaged: ${damage.join(", ")})` : ""}\n`;
}

async function main(): Promise<void> {
  const asked = parse();
  if (!asked) return void process.stdout.write(kHelp);
  const { input, output, profile, lod, overwrite, quiet } = asked;
  await refuse(input, output, overwrite);
  const bytes = await readFile(input).catch((error: unknown) => {
    throw systemError(input, "the file cannot be read", "open_failed", error);
  });
  const { blob, report } = await convert(new File([bytes], basename(input)), { profile, levels: lod }).catch((error: unknown) => {
    if (!(error instanceof RgsError)) throw error;
    throw new End(`${input}: ${error.text}${error.offset === undefined ? "" : ` at byte ${error.offset}`} [${error.code}]`, error.code === "internal" ? 1 : kMachine.includes(error.code) ? 3 : 4);
  });
  await write(output, blob, overwrite).catch((error: unknown) => {
    throw (error as { code?: string }).code === "EEXIST" ? new End(`${output}: it exists; --overwrite replaces it [output_exists]`, 3) : systemError(output, "the file cannot be written", "write_failed", error);
  });
  if (!quiet) process.stdout.write(summary(output, report));
}

main().catch((error: unknown) => {
  process.stderr.write(`${kProgram}: ${error instanceof End ? error.message : String((error as Error)?.stack ?? error)}\n`);
  process.exitCode = error instanceof End ? error.exitCode : 1;
});
