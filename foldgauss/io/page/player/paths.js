// Shared paths: affine maps of model space that depend on time and move many Gaussians, as in foldgauss.video.models.shared_paths.

const IDENTITY = [1, 0, 0, 0, 1, 0];
const latest = new WeakMap(); // by paths, which are never changed in place: the last time and its maps

/**
 * The paths of a file, null for none: `count` of them, each with `knots` times and maps, in double precision. A map is
 * six numbers: rows (L | b). A Gaussian's `path_index` is the number of its path, from 1; 0 for none.
 */
export function pathsOf({ paths }, { path_times: times, path_matrices: matrices }) {
  return paths ? { count: paths.num_paths, knots: paths.num_knots, times: Float64Array.from(times), matrices: Float64Array.from(matrices) } : null;
}

/** The maps of all paths at a time, in turn; the first one, number 0, is the identity. */
export function mapsAt(paths, time) {
  if (latest.get(paths)?.time === time) return latest.get(paths).maps;
  const { count, knots, times, matrices } = paths, maps = new Float64Array(6 * (count + 1));
  maps.set(IDENTITY);
  for (let p = 0; p < count; p++) {
    let last = p * knots;
    const end = last + knots - 1;
    while (last < end - 1 && times[last + 1] <= time) last++;
    const next = Math.min(last + 1, end), span = times[next] - times[last];
    const fraction = span > 0 ? Math.min(Math.max((time - times[last]) / span, 0), 1) : Number(time >= times[next]);
    for (let k = 0; k < 6; k++) maps[6 * (p + 1) + k] = (1 - fraction) * matrices[6 * last + k] + fraction * matrices[6 * next + k];
  }
  latest.set(paths, { time, maps });
  return maps;
}

/**
 * The paths after an edit of a state's selected Gaussians, or null if the edit changes no path. For each path that they
 * follow, `change({times, matrices})` returns the knots of the path that replaces it for them. Returns {paths, numbers}:
 * `numbers[n]` is the number of the path that replaces path n. A path that only selected Gaussians follow is overwritten;
 * otherwise the new path is added.
 */
export function changedPaths({ model: { paths, leaves }, selected }, change) {
  if (!paths) return null;
  const { knots } = paths, taken = new Set([0]), own = new Set(), numbers = [0], made = [];
  leaves.path_index.forEach((path, i) => path && (selected[i] ? own : taken).add(path));
  for (const path of own) {
    const before = { times: paths.times.slice((path - 1) * knots, path * knots), matrices: paths.matrices.slice(6 * (path - 1) * knots, 6 * path * knots) };
    const after = change(before), isSame = (name) => after[name].every((x, k) => x === before[name][k]);
    numbers[path] = path;
    if (isSame("times") && isSame("matrices")) taken.add(path);
    else made.push([path, after]);
  }
  if (!made.length) return null;
  let number = 0;
  for (const one of made) {
    while (taken.has(number)) number++;
    taken.add(number);
    numbers[one[0]] = number;
  }
  const count = Math.max(paths.count, number), grown = (from, width) => {
    const into = new Float64Array(width * count);
    into.set(from);
    return into;
  };
  const times = grown(paths.times, knots), matrices = grown(paths.matrices, 6 * knots);
  for (const [path, after] of made) {
    times.set(after.times, (numbers[path] - 1) * knots);
    matrices.set(after.matrices, 6 * (numbers[path] - 1) * knots);
  }
  return { paths: { count, knots, times, matrices }, numbers };
}

/** A path as seen after the affine map E: x -> M x + e of the frame, (a, b, c, d) = M: its maps A become E A E^-1. */
export function conjugated({ times, matrices }, [a, b, c, d], [x, y]) {
  const determinant = a * d - b * c, after = new Float64Array(matrices.length);
  for (let k = 0; k < matrices.length; k += 6) {
    const [p, q, right, r, s, down] = matrices.subarray(k, k + 6);
    const [top, side] = [[a * p + b * r, a * q + b * s], [c * p + d * r, c * q + d * s]]; // M L
    const [one, other] = [top, side].map(([u, v]) => [(d * u - c * v) / determinant, (a * v - b * u) / determinant]); // M L M^-1
    after.set([...one, a * right + b * down + ((1 - one[0]) * x - one[1] * y), ...other, c * right + d * down + ((1 - other[1]) * y - other[0] * x)], k);
  }
  return { times, matrices: after };
}

/** A path whose time t of [0, 1] is shown at moved(t), which may run backwards; it stands still before and after. */
export function retimed(path, moved) {
  const num = path.times.length, times = path.times.map((t) => Math.min(Math.max(t, 0), 1)), after = times.map(moved), matrices = new Float64Array(6 * num);
  times.forEach((t, k) => matrices.set(mapsAt({ count: 1, knots: num, ...path }, t).subarray(6), 6 * k));
  if (after[0] <= after[num - 1]) return { times: after, matrices };
  return { times: after.reverse(), matrices: matrices.map((_, k) => matrices[6 * (num - 1 - Math.floor(k / 6)) + (k % 6)]) };
}

/** {paths, index} with only the paths that Gaussians are on; `paths` null if there are none. */
export function withoutUnused({ paths, leaves: { path_index: index } }) {
  const used = paths ? [...new Set(index)].filter((path) => path > 0).sort((one, other) => one - other) : [];
  if (!used.length) return { paths: null };
  const take = (from, width) => Float64Array.from(used.flatMap((path) => [...from.subarray((path - 1) * width, path * width)]));
  const { knots } = paths, places = new Map(used.map((path, k) => [path, k + 1]));
  return {
    paths: { count: used.length, knots, times: take(paths.times, knots), matrices: take(paths.matrices, 6 * knots) },
    index: Uint32Array.from(index, (path) => places.get(path) ?? 0),
  };
}
