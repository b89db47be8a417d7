// flip.ts - mean of LDR-FLIP (Andersson et al. 2020), as rgs::flip() computes it.
// SPDX-License-Identifier: Apache-2.0

type Vector = readonly [number, number, number];

const kQc = 0.7;
const kPc = 0.4;
const kPt = 0.95;
/** Degrees: twice the standard deviation of the detectors of edges and points. */
const kFeatureWidth = 0.082;
/** That of rgs::flip(): a monitor of 3840 pixels on 0.7 m, seen from 0.7 m. */
const kPixelsPerDegree = 67.02;
const kRowsAtATime = 8;

/** Linear sRGB to XYZ over the white of D65, so that white is (1, 1, 1). */
const kToXyz = [
  [10135552 / 24577794, 8788810 / 24577794, 4435075 / 24577794],
  [2613072 / 12288897, 8788810 / 12288897, 887015 / 12288897],
  [1425312 / 73733382, 8788810 / 73733382, 70074185 / 73733382],
].map((row) => row.map((value) => value / row.reduce((sum, each) => sum + each))) as unknown as readonly [Vector, Vector, Vector];

function inverse(m: readonly [Vector, Vector, Vector]): readonly [Vector, Vector, Vector] {
  const cofactor = (i: number, j: number): number => {
    const [a, b, c, d] = [(j + 1) % 3, (j + 2) % 3, (i + 1) % 3, (i + 2) % 3] as [0, 1, 2, 0];
    return m[a][c] * m[b][d] - m[a][d] * m[b][c];
  };
  const determinant = m[0][0] * cofactor(0, 0) + m[0][1] * cofactor(1, 0) + m[0][2] * cofactor(2, 0);
  return [0, 1, 2].map((i) => [0, 1, 2].map((j) => cofactor(i, j) / determinant)) as unknown as readonly [Vector, Vector, Vector];
}

const kToRgb = inverse(kToXyz);
const times = (m: readonly [Vector, Vector, Vector], [x, y, z]: Vector): Vector => m.map((row) => row[0] * x + row[1] * y + row[2] * z) as unknown as Vector;

/** YCxCz of a level of 255 each. */
function opponent(levels: Vector): Vector {
  const [x, y, z] = times(kToXyz, levels.map((level) => (level > 0.04045 * 255 ? ((level / 255 + 0.055) / 1.055) ** 2.4 : level / 255 / 12.92)) as unknown as Vector);
  return [116 * y - 16, 500 * (x - y), 200 * (y - z)];
}

/** CIELAB with Hunt's adjustment. */
function huntLab(linear: Vector): Vector {
  const [x, y, z] = times(kToXyz, linear).map((v) => (v > (6 / 29) ** 3 ? Math.cbrt(v) : v / (3 * (6 / 29) ** 2) + 4 / 29)) as unknown as Vector;
  const l = 116 * y - 16;
  return [l, 0.01 * l * 500 * (x - y), 0.01 * l * 200 * (y - z)];
}

/** Of a filtered colour, clamped to what a screen shows. */
function shown(l: number, cx: number, cz: number): Vector {
  const y = (l + 16) / 116;
  return huntLab(times(kToRgb, [y + cx / 500, y, y - cz / 200]).map((v) => Math.min(1, Math.max(0, v))) as unknown as Vector);
}

const hyab = (a: Vector, b: Vector): number => Math.abs(a[0] - b[0]) + Math.hypot(a[1] - b[1], a[2] - b[2]);
const kMostColour = hyab(huntLab([0, 1, 0]), huntLab([0, 0, 1])) ** kQc;

const sumOf = (weights: readonly number[]): number => weights.reduce((sum, each) => sum + each, 0);
const around = (radius: number, weight: (x: number) => number): number[] => Array.from({ length: 2 * radius + 1 }, (_, i) => weight(i - radius));
const normalised = (weights: readonly number[]): number[] => weights.map((weight) => weight / sumOf(weights));

/** A filter of a channel, down the columns and then along the rows. */
interface Filter {
  channel: number;
  down: readonly number[];
  along: readonly number[];
}

function filters(): { all: readonly Filter[]; share: number } {
  const csf = (b: number): number[] => around(Math.ceil((3 * Math.sqrt(0.04 / 2) * kPixelsPerDegree) / Math.PI), (x) => Math.exp(-(((Math.PI * x) / kPixelsPerDegree) ** 2) / b));
  const mass = (a: number, b: number): number => a * Math.sqrt(Math.PI / b) * sumOf(csf(b)) ** 2;
  const [first, second] = [mass(34.1, 0.04), mass(13.5, 0.025)];
  const sd = 0.5 * kFeatureWidth * kPixelsPerDegree;
  const feature = (of: (x: number) => number): number[] => around(Math.ceil(3 * sd), (x) => of(x) * Math.exp((-x * x) / (2 * sd * sd)));
  // The positive weights sum to 1, the negative ones to -1.
  const balanced = (weights: readonly number[]): number[] => {
    const half = (sign: number): number => sumOf(weights.map((weight) => Math.max(0, sign * weight))) || 1;
    return weights.map((weight) => weight / half(Math.sign(weight)));
  };
  const [gauss, edge, point] = [normalised(feature(() => 1)), balanced(feature((x) => -x)), balanced(feature((x) => (x * x) / (sd * sd) - 1))];
  const colours = [[0, 0.0047], [1, 0.0053], [2, 0.04], [2, 0.025]].map(([channel, b]) => ({ channel: channel as number, down: normalised(csf(b as number)), along: normalised(csf(b as number)) }));
  const features = [[gauss, edge], [edge, gauss], [gauss, point], [point, gauss]].map(([down, along]) => ({ channel: 0, down: down as number[], along: along as number[] }));
  return { all: [...colours, ...features], share: first / (first + second) };
}

/** One row of one picture; beyond the edge its pixel repeats. */
function filtered(planes: readonly Float64Array[], { channel, down, along }: Filter, y: number, width: number, height: number): Float64Array {
  const plane = planes[channel] as Float64Array;
  const radius = along.length >> 1;
  const line = new Float64Array(width + 2 * radius);
  down.forEach((weight, i) => {
    const row = width * Math.min(height - 1, Math.max(0, y + i - (down.length >> 1)));
    for (let x = 0; x < width; ++x) line[radius + x] = (line[radius + x] as number) + weight * (plane[row + x] as number);
  });
  line.fill(line[radius] as number, 0, radius).fill(line[radius + width - 1] as number, radius + width);
  const out = new Float64Array(width);
  along.forEach((weight, i) => {
    for (let x = 0; x < width; ++x) out[x] = (out[x] as number) + weight * (line[x + i] as number);
  });
  return out;
}

/** Of RGBA pictures: yields the share that is done, now and then, and returns the mean, from 0, alike, to 1. */
export function* flip(a: Uint8ClampedArray, b: Uint8ClampedArray, width: number, height: number): Generator<number, number> {
  const planes = [a, b].map((pixels) => {
    const all = [0, 1, 2].map(() => new Float64Array(width * height));
    for (let i = 0; i < width * height; ++i) opponent([pixels[4 * i], pixels[4 * i + 1], pixels[4 * i + 2]] as unknown as Vector).forEach((value, c) => ((all[c] as Float64Array)[i] = value));
    return all;
  });
  const { all, share } = filters();
  let sum = 0;
  for (let y = 0; y < height; ++y) {
    if (y % kRowsAtATime === 0) yield y / height;
    const rows = planes.map((each) => all.map((filter) => filtered(each, filter, y, width, height)));
    for (let x = 0; x < width; ++x) {
      const [left, right] = rows.map((each) => {
        const v = each.map((row) => row[x]) as [number, number, number, number, number, number, number, number];
        return { colour: shown(v[0], v[1], share * v[2] + (1 - share) * v[3]), edge: Math.hypot(v[4], v[5]), point: Math.hypot(v[6], v[7]) };
      }) as [{ colour: Vector; edge: number; point: number }, { colour: Vector; edge: number; point: number }];
      const colour = hyab(left.colour, right.colour) ** kQc;
      const knee = kPc * kMostColour;
      const ofColour = colour < knee ? (kPt / knee) * colour : kPt + ((colour - knee) / (kMostColour - knee)) * (1 - kPt);
      const feature = Math.max(Math.abs(left.edge - right.edge), Math.abs(left.point - right.point)) / 116;
      sum += Math.min(1, ofColour) ** (1 - Math.sqrt(Math.min(1, feature / Math.SQRT2)));
    }
  }
  return sum / (width * height);
}
