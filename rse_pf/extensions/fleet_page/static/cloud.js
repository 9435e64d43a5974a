// The point cloud of a map, which is received in parts: a header, then blocks of points.  The points received so far
// are always an even sample of the whole cloud (see packer in clouds.py).

import { BufferAttribute, BufferGeometry, Points, PointsMaterial } from "./vendor/three.module.js";

const BYTES = 9; // bytes of a point: three 16-bit coordinates and three bytes of colour

// A cloud on the graphics card; *header* is that of the packed map, and ready counts the points received so far.
export class Cloud {
  constructor(header) {
    this.ready = 0;
    this.numbers = new Uint16Array(3 * header.points);
    this.colours = new Uint8Array(3 * header.points);
    this.geometry = new BufferGeometry();
    // Positions stay 16-bit integers, as received: the matrix of the three.js object converts them to metres.
    this.geometry.setAttribute("position", new BufferAttribute(this.numbers, 3));
    this.geometry.setAttribute("color", new BufferAttribute(this.colours, 3, true));
    this.geometry.setDrawRange(0, 0);
    this.points = new Points(this.geometry, new PointsMaterial({ size: 1.6, sizeAttenuation: false, vertexColors: true }));
    this.points.matrixAutoUpdate = false;
    this.points.matrix.makeScale(...header.step).setPosition(...header.low);
    this.points.frustumCulled = false;
  }

  // Add the next block: *bytes* holds the positions of *count* points, then their colours.
  take(bytes, count) {
    const [from, all] = [3 * this.ready, 3 * count];
    this.numbers.set(new Uint16Array(bytes.buffer, bytes.byteOffset, all), from);
    this.colours.set(bytes.subarray(2 * all), from);
    for (const attribute of Object.values(this.geometry.attributes)) {
      attribute.addUpdateRange(from, all);
      attribute.needsUpdate = true;
    }
    this.ready += count;
  }

  // Let the next frame draw the received points from number *from* on, at most *most*; return their number.
  show(from, most) {
    const count = Math.min(Math.floor(most), this.ready - from);
    this.geometry.setDrawRange(from, count);
    return count;
  }

  dispose() {
    this.geometry.dispose();
    this.points.material.dispose();
  }
}

// Read a packed map from the body of *answer*: call begin(header) once, then more(bytes, count) for each block.
// Return the header; return null and stop to read once isWanted() is false.
export async function readCloud(answer, isWanted, begin, more) {
  const source = new Source(answer.body.getReader());
  const length = new DataView((await source.read(4)).buffer).getUint32(0, true);
  const header = JSON.parse(new TextDecoder().decode(await source.read(length)));
  if (isWanted()) begin(header);
  for (let have = 0; have < header.points;) {
    const count = Math.min(header.block, header.points - have);
    const bytes = await source.read(BYTES * count);
    if (!isWanted()) {
      await source.reader.cancel();
      return null;
    }
    more(bytes, count);
    have += count;
  }
  return isWanted() ? header : null;
}

// Reads exact numbers of bytes from a stream, whose chunks have any size.
class Source {
  constructor(reader) {
    this.reader = reader;
    this.rest = new Uint8Array(0);
  }

  // Return the next *size* bytes in a new buffer of that size; throw an error if the stream ends before.
  async read(size) {
    const bytes = new Uint8Array(size);
    for (let have = 0; have < size;) {
      if (!this.rest.length) {
        const { done, value } = await this.reader.read();
        if (done) throw new Error("the cloud ended early");
        this.rest = value;
      }
      const part = this.rest.subarray(0, size - have);
      bytes.set(part, have);
      have += part.length;
      this.rest = this.rest.subarray(part.length);
    }
    return bytes;
  }
}
