// Arrays of npz files as the service writes them: members that are stored whole, each a npy file of version 1.

const DIRECTORY_END = 0x06054b50;
const END_BYTES = 22; // where an archive has no comment
const ENTRY_BYTES = 46;
const MEMBER_BYTES = 30;

/** By name {descr, shape, data}; `data` is a Uint8Array. Throws where the file is of another form. */
export function arraysOf(buffer) {
  const view = new DataView(buffer);
  const end = buffer.byteLength - END_BYTES;
  if (end < 0 || view.getUint32(end, true) !== DIRECTORY_END) throw new Error("not a whole npz file");
  const found = {};
  let place = view.getUint32(end + 16, true);
  for (let left = view.getUint16(end + 10, true); left > 0; left -= 1) {
    const [nameBytes, extraBytes, commentBytes] = [28, 30, 32].map((offset) => view.getUint16(place + offset, true));
    const name = text(buffer, place + ENTRY_BYTES, nameBytes).replace(/\.npy$/, "");
    if (view.getUint16(place + 10, true) !== 0) throw new Error(`${name} is compressed`);
    found[name] = arrayAt(buffer, dataOf(view, view.getUint32(place + 42, true)));
    place += ENTRY_BYTES + nameBytes + extraBytes + commentBytes;
  }
  return found;
}

// Behind the member's own header, whose extra field may differ from the directory's.
function dataOf(view, member) {
  return member + MEMBER_BYTES + view.getUint16(member + 26, true) + view.getUint16(member + 28, true);
}

function arrayAt(buffer, start) {
  const headerBytes = new DataView(buffer).getUint16(start + 8, true);
  const header = text(buffer, start + 10, headerBytes);
  const descr = /'descr': '([^']+)'/.exec(header)[1];
  const shape = /'shape': \(([^)]*)\)/.exec(header)[1].split(",").filter((each) => each.trim()).map(Number);
  const size = Number(/\d+$/.exec(descr)[0]) * shape.reduce((product, axis) => product * axis, 1);
  return { descr, shape, data: new Uint8Array(buffer, start + 10 + headerBytes, size) };
}

const text = (buffer, start, length) => new TextDecoder("latin1").decode(new Uint8Array(buffer, start, length));
