// An ONNX file read to a graph: nodes, the tensors that they begin with, and the names of what goes in and comes out. Field numbers are
// those of https://github.com/onnx/onnx/blob/main/onnx/onnx.proto, bytes those of protobuf.
//
// A tensor is {dims, data}: data is a Float32Array, or a Float64Array of whole numbers and truth values.

const VARINT = 0;
const EIGHT_BYTES = 1;
const LENGTH = 2;
const FOUR_BYTES = 5;

/** A varint as [number, index after it]; negative where it is a two's complement of 64 bits. */
function varint(bytes, start) {
  let value = 0n;
  for (let at = start, shift = 0n; at < bytes.length && shift < 70n; at++, shift += 7n) {
    value |= BigInt(bytes[at] & 0x7f) << shift;
    if (bytes[at] < 0x80) return [Number(BigInt.asIntN(64, value)), at + 1];
  }
  throw new Error("the graph is damaged: a number has no end");
}

/** The fields of a message: {number, kind, value}, where value is a number or the bytes of a field with a length. */
function* fieldsOf(bytes) {
  for (let at = 0; at < bytes.length; ) {
    let key;
    let value;
    [key, at] = varint(bytes, at);
    const kind = key & 7;
    if (kind === VARINT) [value, at] = varint(bytes, at);
    else {
      let length = kind === EIGHT_BYTES ? 8 : 4;
      if (kind === LENGTH) [length, at] = varint(bytes, at);
      else if (kind !== EIGHT_BYTES && kind !== FOUR_BYTES) throw new Error("the graph is damaged: it is no protobuf message");
      if (length < 0 || length > bytes.length - at) throw new Error("the graph is damaged: it ends within a message");
      value = bytes.subarray(at, at + length);
      at += length;
    }
    yield { number: key >>> 3, kind, value };
  }
}

const text = (bytes) => new TextDecoder().decode(bytes);
const view = (bytes) => new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);

/** The whole numbers of a repeated field, packed or not. */
function integers({ kind, value }) {
  if (kind === VARINT) return [value];
  const found = [];
  for (let at = 0; at < value.length; ) {
    let one;
    [one, at] = varint(value, at);
    found.push(one);
  }
  return found;
}

function floats({ value }) {
  const from = view(value);
  return Array.from({ length: value.length / 4 }, (_, i) => from.getFloat32(4 * i, true));
}

/** A half-precision number from its bits. */
function half(bits) {
  const sign = bits & 0x8000 ? -1 : 1;
  const exponent = (bits >> 10) & 0x1f;
  const fraction = bits & 0x3ff;
  if (exponent === 0) return sign * fraction * 2 ** -24;
  if (exponent === 0x1f) return fraction ? Number.NaN : sign * Number.POSITIVE_INFINITY;
  return sign * (1 + fraction / 1024) * 2 ** (exponent - 15);
}

/** How the types of TensorProto that are known here are stored: bytes of a number, how one is read, and whether it has a fraction. */
const TYPES = {
  1: { bytes: 4, read: (from, at) => from.getFloat32(at, true), isFloat: true },
  2: { bytes: 1, read: (from, at) => from.getUint8(at) },
  3: { bytes: 1, read: (from, at) => from.getInt8(at) },
  6: { bytes: 4, read: (from, at) => from.getInt32(at, true) },
  7: { bytes: 8, read: (from, at) => Number(from.getBigInt64(at, true)) },
  9: { bytes: 1, read: (from, at) => from.getUint8(at) },
  10: { bytes: 2, read: (from, at) => half(from.getUint16(at, true)), isFloat: true },
  11: { bytes: 8, read: (from, at) => from.getFloat64(at, true), isFloat: true },
};

export const isFloatType = (number) => TYPES[number]?.isFloat ?? false;

function tensor(bytes) {
  const read = { dims: [], type: 0, name: "", raw: null, listed: [] };
  for (const field of fieldsOf(bytes)) {
    if (field.number === 1) read.dims.push(...integers(field));
    else if (field.number === 2) read.type = field.value;
    else if (field.number === 4) read.listed.push(...floats(field));
    else if (field.number === 5 || field.number === 7) read.listed.push(...integers(field));
    else if (field.number === 8) read.name = text(field.value);
    else if (field.number === 9) read.raw = field.value;
    else if (field.number === 13) throw new Error(`tensor ${read.name} of the graph lies in another file`);
  }
  const { dims, type, name, raw, listed } = read;
  if (!TYPES[type]) throw new Error(`tensor ${name} of the graph has type ${type}, which is not known here`);
  const { bytes: width, read: one, isFloat } = TYPES[type];
  const size = dims.reduce((product, length) => product * length, 1);
  const found = raw === null ? listed.length : raw.length / width;
  if (found !== size) throw new Error(`tensor ${name} of the graph is damaged: it has ${found} of ${size} numbers`);
  const data = isFloat ? new Float32Array(size) : new Float64Array(size);
  if (raw === null) data.set(type === 10 ? listed.map(half) : listed);
  else {
    const from = view(raw);
    for (let i = 0; i < size; i++) data[i] = one(from, i * width);
  }
  return { name, tensor: { dims, data } };
}

/** [name, value] of an attribute: a number, a text, a tensor, or an array of numbers. */
function attribute(bytes) {
  let name = "";
  let value = [];
  for (const field of fieldsOf(bytes)) {
    if (field.number === 1) name = text(field.value);
    else if (field.number === 2) value = view(field.value).getFloat32(0, true);
    else if (field.number === 3) value = field.value;
    else if (field.number === 4) value = text(field.value);
    else if (field.number === 5) value = tensor(field.value).tensor;
    else if (field.number === 7) value.push(...floats(field));
    else if (field.number === 8) value.push(...integers(field));
  }
  return [name, value];
}

function node(bytes) {
  const read = { operator: "", domain: "", inputs: [], outputs: [], attributes: {} };
  for (const { number, value } of fieldsOf(bytes)) {
    if (number === 1) read.inputs.push(text(value));
    else if (number === 2) read.outputs.push(text(value));
    else if (number === 4) read.operator = text(value);
    else if (number === 5) {
      const [name, given] = attribute(value);
      read.attributes[name] = given;
    } else if (number === 7) read.domain = text(value);
  }
  return read;
}

const nameOf = (bytes) => {
  for (const { number, value } of fieldsOf(bytes)) if (number === 1) return text(value);
  return "";
};

/**
 * Reads an ONNX file (Uint8Array) to {nodes, tensors, inputs, outputs}: nodes in their order, tensors by name, and the names of what goes in
 * and comes out. Throws Error for bytes that are no graph, and for weights that are not in them.
 */
export function readGraph(bytes) {
  const graph = { nodes: [], tensors: new Map(), inputs: [], outputs: [] };
  for (const of of fieldsOf(bytes)) {
    if (of.number !== 7) continue;
    for (const { number, value } of fieldsOf(of.value)) {
      if (number === 1) graph.nodes.push(node(value));
      else if (number === 5) {
        const { name, tensor: read } = tensor(value);
        graph.tensors.set(name, read);
      } else if (number === 11) graph.inputs.push(nameOf(value));
      else if (number === 12) graph.outputs.push(nameOf(value));
    }
  }
  if (graph.outputs.length === 0) throw new Error("the graph has no output");
  graph.inputs = graph.inputs.filter((name) => !graph.tensors.has(name));
  return graph;
}
