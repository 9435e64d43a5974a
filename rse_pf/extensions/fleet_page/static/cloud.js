// A cloud as it arrives: a head, then blocks of points, each a sample of the whole.

import { BufferAttribute, BufferGeometry, Points, PointsMaterial } from "./vendor/three.module.js";

const BYTES = 9; // three 16-bit numbers and three bytes of colour

export class Cloud {
  constructor(told) {
    this.told = told;
    this.ready = 0;
    this.numbers = new Uint16Array(3 * told.points);
    this.colours = new Uint8Array(3 * told.points);
    this.geometry = new BufferGeometry();
    // Positions stay the 16-bit numbers that came: the object's matrix makes metres of them.
    this.geometry.setAttribute("position", new BufferAttribute(this.numbers, 3));
    this.geometry.setAttribute("color", new BufferAttribute(this.colours, 3, true));
    this.geometry.setDrawRange(0, 0);
    this.points = new Points(this.geometry, new PointsMaterial({ size: 1.6, sizeAttenuation: false, vertexColors: true }));
    this.points.matrixAutoUpdate = false;
    this.points.matrix.makeScale(...told.step).setPosition(...told.low);
    this.points.frustumCulled = false;
  }

  // Take the bytes of the next block.
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

  // Draw the points from number *from* on, at most *most*; return how many these are.
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

// Calls begin(told) once, then more(bytes, count) for each block of the body of *answer*; returns told, null
// if the cloud is no longer wanted.
export async function readCloud(answer, isWanted, begin, more) {
  const source = new Source(answer.body.getReader());
  const length = new DataView((await source.read(4)).buffer).getUint32(0, true);
  const told = JSON.parse(new TextDecoder().decode(await source.read(length)));
  if (isWanted()) begin(told);
  for (let have = 0; have < told.points;) {
    const count = Math.min(told.block, told.points - have);
    const bytes = await source.read(BYTES * count);
    if (!isWanted()) {
      await source.reader.cancel();
      return null;
    }
    more(bytes, count);
    have += count;
  }
  return isWanted() ? told : null;
}

class Source {
  constructor(reader) {
    this.reader = reader;
    this.rest = new Uint8Array(0);
  }

  // Return the next *size* bytes, at the start of a buffer of their own.
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
