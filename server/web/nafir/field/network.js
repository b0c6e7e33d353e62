// Runs the network of a field: the arithmetic of an ONNX graph, one operator after the other, on tensors {dims, data}. Only the operators
// are here that fields of directions are made of. What does not depend on the inputs is computed once.

import { isFloatType, readGraph } from "./onnx.js";

const sizeOf = (dims) => dims.reduce((product, length) => product * length, 1);
const isFloat = ({ data }) => data instanceof Float32Array;
const like = (isReal, size) => (isReal ? new Float32Array(size) : new Float64Array(size));
const axisOf = (axis, rank) => (axis < 0 ? axis + rank : axis);
const scalar = ({ data }) => data[0];

/** Steps in memory from one index of each axis to the next. */
function stridesOf(dims) {
  const strides = new Array(dims.length).fill(1);
  for (let axis = dims.length - 2; axis >= 0; axis--) strides[axis] = strides[axis + 1] * dims[axis + 1];
  return strides;
}

function broadcastDims(all) {
  const rank = Math.max(...all.map((dims) => dims.length));
  return Array.from({ length: rank }, (_, axis) => {
    let length = 1;
    for (const dims of all) {
      const own = dims[axis - rank + dims.length] ?? 1;
      if (own !== 1 && length !== 1 && own !== length) throw new Error(`shapes ${all.join(" and ")} do not fit together`);
      if (own !== 1) length = own;
    }
    return length;
  });
}

/** Steps of a tensor with `dims` along the axes of `wide`, to which it is broadcast. */
function broadcastStrides(dims, wide) {
  const own = stridesOf(dims);
  const missing = wide.length - dims.length;
  return wide.map((_, axis) => (axis < missing || dims[axis - missing] === 1 ? 0 : own[axis - missing]));
}

/** Calls visit(number, offsets) for each index of `dims`, with the offset of each list of strides. */
function walk(dims, strides, visit) {
  const index = new Array(dims.length).fill(0);
  const offsets = new Array(strides.length).fill(0);
  const size = sizeOf(dims);
  for (let number = 0; number < size; number++) {
    visit(number, offsets);
    for (let axis = dims.length - 1; axis >= 0; axis--) {
      index[axis]++;
      for (let i = 0; i < strides.length; i++) offsets[i] += strides[i][axis];
      if (index[axis] < dims[axis]) break;
      for (let i = 0; i < strides.length; i++) offsets[i] -= strides[i][axis] * dims[axis];
      index[axis] = 0;
    }
  }
}

const each = (of) => ([x]) => {
  const data = like(isFloat(x), x.data.length);
  for (let i = 0; i < data.length; i++) data[i] = of(x.data[i]);
  return [{ dims: x.dims, data }];
};

function pair(of, a, b) {
  const dims = broadcastDims([a.dims, b.dims]);
  const data = like(isFloat(a) || isFloat(b), sizeOf(dims));
  if (a.data.length === data.length && b.data.length === data.length) {
    for (let i = 0; i < data.length; i++) data[i] = of(a.data[i], b.data[i]);
  } else {
    walk(dims, [broadcastStrides(a.dims, dims), broadcastStrides(b.dims, dims)], (i, [at, from]) => {
      data[i] = of(a.data[at], b.data[from]);
    });
  }
  return { dims, data };
}

const both = (of) => ([a, b]) => [pair(of, a, b)];
const all = (of) => ([first, ...others]) => [others.reduce((sum, other) => pair(of, sum, other), first)];

/** The error function, by a series whose terms are all positive. */
function errorFunction(x) {
  const size = Math.abs(x);
  if (size > 5) return Math.sign(x);
  let term = size;
  let sum = size;
  for (let n = 1; term > 1e-12 * sum; n++) {
    term *= (2 * x * x) / (2 * n + 1);
    sum += term;
  }
  return (Math.sign(x) * 2 * Math.exp(-x * x) * sum) / Math.sqrt(Math.PI);
}

const gelu = (x) => 0.5 * x * (1 + errorFunction(x * Math.SQRT1_2));
const geluByTanh = (x) => 0.5 * x * (1 + Math.tanh(Math.sqrt(2 / Math.PI) * (x + 0.044715 * x ** 3)));

/** Adds a (rows, inner) times b (inner, columns) to out (rows, columns), four rows of b at a time. */
function multiply(a, aAt, b, bAt, out, outAt, rows, inner, columns) {
  for (let row = 0; row < rows; row++) {
    const from = aAt + row * inner;
    const to = outAt + row * columns;
    let k = 0;
    for (; k + 3 < inner; k += 4) {
      const x0 = a[from + k];
      const x1 = a[from + k + 1];
      const x2 = a[from + k + 2];
      const x3 = a[from + k + 3];
      const b0 = bAt + k * columns;
      const b1 = b0 + columns;
      const b2 = b1 + columns;
      const b3 = b2 + columns;
      for (let i = 0; i < columns; i++) out[to + i] += x0 * b[b0 + i] + x1 * b[b1 + i] + x2 * b[b2 + i] + x3 * b[b3 + i];
    }
    for (; k < inner; k++) {
      const x = a[from + k];
      const at = bAt + k * columns;
      for (let i = 0; i < columns; i++) out[to + i] += x * b[at + i];
    }
  }
}

/** Adds a (rows, inner) times the transpose of b (columns, inner) to out (rows, columns). */
function multiplyByTransposed(a, b, out, rows, inner, columns) {
  for (let row = 0; row < rows; row++) {
    const from = row * inner;
    for (let column = 0; column < columns; column++) {
      const other = column * inner;
      // Four sums, so that no addition waits for the one before it.
      let s0 = 0;
      let s1 = 0;
      let s2 = 0;
      let s3 = 0;
      let k = 0;
      for (; k + 3 < inner; k += 4) {
        s0 += a[from + k] * b[other + k];
        s1 += a[from + k + 1] * b[other + k + 1];
        s2 += a[from + k + 2] * b[other + k + 2];
        s3 += a[from + k + 3] * b[other + k + 3];
      }
      for (; k < inner; k++) s0 += a[from + k] * b[other + k];
      out[row * columns + column] += s0 + s1 + s2 + s3;
    }
  }
}

function transposed({ dims, data }, order) {
  const to = order.map((axis) => dims[axis]);
  const strides = stridesOf(dims);
  const moved = like(data instanceof Float32Array, data.length);
  walk(to, [order.map((axis) => strides[axis])], (i, [at]) => {
    moved[i] = data[at];
  });
  return { dims: to, data: moved };
}

function gemm([a, b, c], { alpha = 1, beta = 1, transA = 0, transB = 0 }) {
  const left = transA ? transposed(a, [1, 0]) : a;
  const [rows, inner] = left.dims;
  const columns = transB ? b.dims[0] : b.dims[1];
  const data = new Float32Array(rows * columns);
  if (transB) multiplyByTransposed(left.data, b.data, data, rows, inner, columns);
  else multiply(left.data, 0, b.data, 0, data, 0, rows, inner, columns);
  if (alpha !== 1) for (let i = 0; i < data.length; i++) data[i] *= alpha;
  const product = { dims: [rows, columns], data };
  return [c ? pair((x, y) => x + beta * y, product, c) : product];
}

function matmul([a, b]) {
  const [left, right] = [a.dims.length === 1 ? [1, ...a.dims] : a.dims, b.dims.length === 1 ? [...b.dims, 1] : b.dims];
  const [rows, inner, columns] = [left.at(-2), left.at(-1), right.at(-1)];
  if (right.at(-2) !== inner) throw new Error(`shapes ${a.dims} and ${b.dims} do not fit together`);
  const batch = broadcastDims([left.slice(0, -2), right.slice(0, -2)]);
  const data = new Float32Array(sizeOf(batch) * rows * columns);
  const strides = [left, right].map((dims) => broadcastStrides(dims.slice(0, -2), batch));
  walk(batch, strides, (i, [at, from]) => {
    multiply(a.data, at * rows * inner, b.data, from * inner * columns, data, i * rows * columns, rows, inner, columns);
  });
  const dims = [...batch, rows, columns];
  if (b.dims.length === 1) dims.pop();
  if (a.dims.length === 1) dims.splice(batch.length, 1);
  return [{ dims, data }];
}

function concat(tensors, { axis }) {
  const along = axisOf(axis, tensors[0].dims.length);
  const dims = [...tensors[0].dims];
  dims[along] = tensors.reduce((sum, tensor) => sum + tensor.dims[along], 0);
  const data = like(isFloat(tensors[0]), sizeOf(dims));
  const outer = sizeOf(dims.slice(0, along));
  let to = 0;
  for (let row = 0; row < outer; row++) {
    for (const tensor of tensors) {
      const run = tensor.data.length / outer;
      data.set(tensor.data.subarray(row * run, (row + 1) * run), to);
      to += run;
    }
  }
  return [{ dims, data }];
}

/** A part of a tensor: along each axis so many indices from a first one on, in steps. */
function part({ dims, data }, starts, counts, steps) {
  const strides = stridesOf(dims);
  const first = starts.reduce((sum, start, axis) => sum + start * strides[axis], 0);
  const taken = like(data instanceof Float32Array, sizeOf(counts));
  walk(counts, [strides.map((stride, axis) => stride * steps[axis])], (i, [at]) => {
    taken[i] = data[first + at];
  });
  return { dims: counts, data: taken };
}

function slice([x, begins, ends, along, paces]) {
  const rank = x.dims.length;
  const starts = new Array(rank).fill(0);
  const counts = [...x.dims];
  const steps = new Array(rank).fill(1);
  begins.data.forEach((begin, i) => {
    const axis = axisOf(along ? along.data[i] : i, rank);
    const length = x.dims[axis];
    const step = paces ? paces.data[i] : 1;
    if (step < 1) throw new Error("slices in steps backwards are not known here");
    const within = (at) => Math.min(length, Math.max(0, at < 0 ? at + length : at));
    starts[axis] = within(begin);
    counts[axis] = Math.max(0, Math.ceil((within(ends.data[i]) - starts[axis]) / step));
    steps[axis] = step;
  });
  return [part(x, starts, counts, steps)];
}

function split([x, lengths], { axis = 0, num_outputs: count }, outputs) {
  const along = axisOf(axis, x.dims.length);
  const each_ = Math.ceil(x.dims[along] / (count ?? outputs));
  const sizes = lengths ? [...lengths.data] : Array.from({ length: outputs }, (_, i) => Math.min(each_, x.dims[along] - i * each_));
  const steps = x.dims.map(() => 1);
  let at = 0;
  return sizes.map((size) => {
    const starts = x.dims.map((_, other) => (other === along ? at : 0));
    at += size;
    return part(x, starts, x.dims.map((length, other) => (other === along ? size : length)), steps);
  });
}

function reshape([x, shape], { allowzero = 0 }) {
  const dims = Array.from(shape.data, (length, axis) => (length === 0 && !allowzero ? x.dims[axis] : length));
  const open = dims.indexOf(-1);
  if (open >= 0) dims[open] = x.data.length / -sizeOf(dims);
  if (sizeOf(dims) !== x.data.length) throw new Error(`a tensor of shape ${x.dims} has no shape ${dims}`);
  return [{ dims, data: x.data }];
}

function unsqueeze([x, axes]) {
  const rank = x.dims.length + axes.data.length;
  const added = new Set(Array.from(axes.data, (axis) => axisOf(axis, rank)));
  const own = [...x.dims];
  return [{ dims: Array.from({ length: rank }, (_, axis) => (added.has(axis) ? 1 : own.shift())), data: x.data }];
}

function squeeze([x, axes]) {
  const gone = axes ? new Set(Array.from(axes.data, (axis) => axisOf(axis, x.dims.length))) : null;
  return [{ dims: x.dims.filter((length, axis) => (gone ? !gone.has(axis) : length !== 1)), data: x.data }];
}

function gather([x, indices], { axis = 0 }) {
  const along = axisOf(axis, x.dims.length);
  const inner = sizeOf(x.dims.slice(along + 1));
  const outer = sizeOf(x.dims.slice(0, along));
  const count = indices.data.length;
  const data = like(isFloat(x), outer * count * inner);
  for (let row = 0; row < outer; row++) {
    indices.data.forEach((index, i) => {
      const from = (row * x.dims[along] + axisOf(index, x.dims[along])) * inner;
      data.set(x.data.subarray(from, from + inner), (row * count + i) * inner);
    });
  }
  return [{ dims: [...x.dims.slice(0, along), ...indices.dims, ...x.dims.slice(along + 1)], data }];
}

/** Sums over axes of what `of` makes of each number; `finish(sum, count)` makes the result of it. */
const reduce = (of, finish = (sum) => sum) => ([x, given], { axes = null, keepdims = 1, noop_with_empty_axes: keepsAll = 0 }) => {
  const rank = x.dims.length;
  const listed = given ? [...given.data] : (axes ?? []);
  if (listed.length === 0 && keepsAll) return [x];
  const gone = new Set(listed.length === 0 ? x.dims.keys() : listed.map((axis) => axisOf(axis, rank)));
  const kept = x.dims.map((length, axis) => (gone.has(axis) ? 1 : length));
  const sums = new Float64Array(sizeOf(kept));
  walk(x.dims, [broadcastStrides(kept, x.dims)], (i, [to]) => {
    sums[to] += of(x.data[i]);
  });
  const data = like(isFloat(x), sums.length);
  for (let i = 0; i < data.length; i++) data[i] = finish(sums[i], x.data.length / sums.length);
  return [{ dims: keepdims ? kept : x.dims.filter((_, axis) => !gone.has(axis)), data }];
};

function softmax([x], { axis = -1 }) {
  const along = axisOf(axis, x.dims.length);
  const length = x.dims[along];
  const inner = sizeOf(x.dims.slice(along + 1));
  const data = new Float32Array(x.data.length);
  for (let start = 0; start < data.length; start += length * inner) {
    for (let at = start; at < start + inner; at++) {
      let most = -Infinity;
      for (let i = 0; i < length; i++) most = Math.max(most, x.data[at + i * inner]);
      let sum = 0;
      for (let i = 0; i < length; i++) sum += data[at + i * inner] = Math.exp(x.data[at + i * inner] - most);
      for (let i = 0; i < length; i++) data[at + i * inner] /= sum;
    }
  }
  return [{ dims: x.dims, data }];
}

function clip([x, least, most]) {
  const low = least ? scalar(least) : -Infinity;
  const high = most ? scalar(most) : Infinity;
  return each((value) => Math.min(high, Math.max(low, value)))([x]);
}

function cast([x], { to }) {
  const data = like(isFloatType(to), x.data.length);
  for (let i = 0; i < data.length; i++) data[i] = isFloatType(to) ? x.data[i] : to === 9 ? x.data[i] !== 0 : Math.trunc(x.data[i]);
  return [{ dims: x.dims, data }];
}

/** What each operator computes: (inputs, attributes, number of outputs) to outputs. Inputs that are left out are undefined. */
const OPERATORS = {
  Abs: each(Math.abs),
  Add: both((a, b) => a + b),
  Cast: cast,
  Clip: clip,
  Concat: concat,
  Constant: (_, { value, value_float: real, value_floats: reals }) => {
    if (value) return [value];
    return [reals ? { dims: [reals.length], data: Float32Array.from(reals) } : { dims: [], data: Float32Array.of(real) }];
  },
  Cos: each(Math.cos),
  Div: both((a, b) => a / b),
  Erf: each(errorFunction),
  Exp: each(Math.exp),
  Expand: ([x, shape]) => [pair((a) => a, x, { dims: [...shape.data], data: new Float64Array(sizeOf([...shape.data])) })],
  Floor: each(Math.floor),
  Gather: gather,
  Gelu: (inputs, { approximate = "none" }) => each(approximate === "tanh" ? geluByTanh : gelu)(inputs),
  Gemm: gemm,
  Identity: ([x]) => [x],
  LeakyRelu: (inputs, { alpha = 0.01 }) => each((x) => (x < 0 ? alpha * x : x))(inputs),
  Log: each(Math.log),
  MatMul: matmul,
  Max: all(Math.max),
  Min: all(Math.min),
  Mul: both((a, b) => a * b),
  Neg: each((x) => -x),
  Pow: both((a, b) => a ** b),
  Reciprocal: each((x) => 1 / x),
  ReduceL2: reduce((x) => x * x, Math.sqrt),
  ReduceMean: reduce((x) => x, (sum, count) => sum / count),
  ReduceSum: reduce((x) => x),
  ReduceSumSquare: reduce((x) => x * x),
  Relu: each((x) => Math.max(0, x)),
  Reshape: reshape,
  Sigmoid: each((x) => 1 / (1 + Math.exp(-x))),
  Sin: each(Math.sin),
  Slice: slice,
  Softmax: softmax,
  Split: split,
  Sqrt: each(Math.sqrt),
  Squeeze: squeeze,
  Sub: both((a, b) => a - b),
  Sum: all((a, b) => a + b),
  Tanh: each(Math.tanh),
  Transpose: ([x], { perm }) => [transposed(x, perm ?? [...x.dims.keys()].reverse())],
  Unsqueeze: unsqueeze,
};

export class Network {
  #nodes;
  #tensors;

  /** `bytes` (Uint8Array) are those of an ONNX file. Throws Error for one that is damaged or needs an operator that is not known here. */
  constructor(bytes) {
    const { nodes, tensors, inputs, outputs } = readGraph(bytes);
    this.inputs = inputs;
    this.outputs = outputs;
    const strange = nodes.filter(({ operator, domain }) => !(operator in OPERATORS) || !["", "ai.onnx"].includes(domain));
    if (strange.length > 0) {
      const names = [...new Set(strange.map(({ operator, domain }) => (domain ? `${domain}.${operator}` : operator)))];
      throw new Error(`the graph needs ${names.sort().join(", ")}, which a browser's field does not know`);
    }
    this.#tensors = tensors;
    this.#nodes = nodes.filter((node) => {
      if (!node.inputs.every((name) => name === "" || tensors.has(name))) return true;
      this.#compute(node, tensors);
      return false;
    });
  }

  #compute({ operator, inputs, outputs, attributes }, tensors) {
    const given = inputs.map((name) => (name === "" ? undefined : tensors.get(name)));
    const missing = inputs.find((name, i) => name !== "" && given[i] === undefined);
    if (missing !== undefined) throw new Error(`nothing computes ${missing}, an input of ${operator}`);
    const computed = OPERATORS[operator](given, attributes, outputs.length);
    outputs.forEach((name, i) => tensors.set(name, computed[i]));
  }

  /** Runs the network. `given` has the inputs by name as {dims, data}, and the result the outputs. */
  run(given) {
    const tensors = new Map(this.#tensors);
    for (const name of this.inputs) {
      if (!given[name]) throw new Error(`the graph's input ${name} is not given`);
      tensors.set(name, given[name]);
    }
    for (const node of this.#nodes) this.#compute(node, tensors);
    return Object.fromEntries(this.outputs.map((name) => [name, tensors.get(name)]));
  }
}
