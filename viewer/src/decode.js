// From the packed bytes of a scene to typed arrays. The packing is written down in vstent/report/packing.py.
import { unzlibSync } from "fflate";
export { zipSync } from "fflate";

const ARRAYS = { u8: Uint8Array, u16: Uint16Array, u32: Uint32Array };

/** Bytes of a base64 text that holds a zlib stream. */
export function unpack(base64) {
  const text = atob(base64.trim());
  const bytes = new Uint8Array(text.length);
  for (let i = 0; i < text.length; i++) bytes[i] = text.charCodeAt(i);
  return unzlibSync(bytes).buffer;
}

/** The integers of a block, as they lie in the buffer. */
export function integers(buffer, block) {
  return new ARRAYS[block.type](buffer, block.offset, block.length);
}

/** The numbers of a quantised block: low + step * integer, component by component. */
export function numbers(buffer, block) {
  const packed = integers(buffer, block);
  const values = new Float32Array(packed.length);
  const width = block.low.length;
  for (let i = 0; i < values.length; i++) {
    const k = i % width;
    values[i] = block.low[k] + block.step[k] * packed[i];
  }
  return values;
}

/** Manifest and bytes of a message: the length of the manifest in four bytes, the manifest, the bytes. */
export function opened(message) {
  const length = new DataView(message).getUint32(0, true);
  const manifest = JSON.parse(new TextDecoder().decode(new Uint8Array(message, 4, length)));
  return { manifest, buffer: message.slice(4 + length) };
}
