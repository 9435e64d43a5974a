// Send frames of this device's camera to the service object-recognition, and draw the poses that come back.
// One frame is on its way at a time, so a slow network gets fewer frames and never old ones.

import { connect } from "/rse-pf.js";

const WIDTH = 640;
const HEIGHT = 480;
const JPEG_QUALITY = 0.8;
// A server starts an isolated process for the first frame.
const DEADLINE_MS = 5000;

// No later frame would be answered: the platform has no such service, or the token no scope for it.
const FINAL = ["unknown-service", "forbidden"];

const form = document.forms[0];
const said = document.querySelector("output");
const shown = document.querySelector("pre");
const canvas = document.querySelector("canvas");
const drawing = canvas.getContext("2d");
const video = document.createElement("video");
const frame = new OffscreenCanvas(WIDTH, HEIGHT);

// What stands behind the # of an address is sent to nobody.
for (const [name, value] of new URLSearchParams(location.hash.slice(1))) if (form[name]) form[name].value = value;
const scheme = location.protocol === "https:" ? "wss" : "ws";
form.url.value ||= `${scheme}://${location.hostname}:8700/ws`;

form.onsubmit = async (event) => {
  event.preventDefault();
  form.querySelector("button").disabled = true;
  try {
    const given = { tag_m: Number(form.tag.value), tags_only: !form.cover.checked };
    await run(form.url.value, form.token.value, Number(form.focal.value), given);
  } catch (error) {
    said.textContent = explained(error);
    form.querySelector("button").disabled = false;
  }
};

function explained(error) {
  return error.hint ? `${error.message} (${error.hint})` : `${error.name}: ${error.message}`;
}

async function run(url, token, focalPx, given) {
  said.textContent = "asking for the camera";
  if (!navigator.mediaDevices) throw new Error("browsers give the camera to https pages and to localhost only");
  const wanted = { width: WIDTH, height: HEIGHT, facingMode: "environment" };
  video.srcObject = await navigator.mediaDevices.getUserMedia({ video: wanted });
  video.muted = video.playsInline = true;
  await video.play();
  said.textContent = "connecting";
  const robot = await connect(url, { token, onChange: (what, why) => (said.textContent = `${what}: ${why}`) });
  const camera = [focalPx, focalPx, (WIDTH - 1) / 2, (HEIGHT - 1) / 2];
  while (!robot.error) await look(robot, { camera, ...given });
  throw robot.error;
}

/** Send one frame, and show what it shows. */
async function look(robot, given) {
  const context = frame.getContext("2d");
  await new Promise((done) => video.requestVideoFrameCallback(done));
  context.drawImage(video, 0, 0, WIDTH, HEIGHT);
  const began = performance.now();
  const image = new Uint8Array(await (await frame.convertToBlob({ type: "image/jpeg", quality: JPEG_QUALITY })).arrayBuffer());
  const encodeMs = performance.now() - began;
  const before = robot.stats.bytesOut;
  try {
    const options = { stream: "camera", deadlineMs: DEADLINE_MS };
    const answer = await robot.call("object-recognition", { image, ...given }, options);
    const bytes = robot.stats.bytesOut - before;
    said.textContent = `connected to ${robot.server} as ${robot.robot}`;
    draw(answer.reply.found, given.camera, given.tag_m);
    tell(answer, { encodeMs, jpegBytes: image.length, bytes });
  } catch (error) {
    if (robot.error) return;
    said.textContent = explained(error);
    if (FINAL.includes(error.code)) {
      robot.close();
      throw error;
    }
  }
}

function draw(found, camera, tagM) {
  drawing.drawImage(frame, 0, 0);
  drawing.lineWidth = 3;
  for (const { T_camera_object: T } of found) {
    const at = (x, y, z) => project(T, camera, x * tagM, y * tagM, z * tagM);
    line("#ff0", [at(-0.5, -0.5, 0), at(0.5, -0.5, 0), at(0.5, 0.5, 0), at(-0.5, 0.5, 0), at(-0.5, -0.5, 0)]);
    line("#f00", [at(0, 0, 0), at(0.5, 0, 0)]);
    line("#0c0", [at(0, 0, 0), at(0, 0.5, 0)]);
    line("#06f", [at(0, 0, 0), at(0, 0, -0.5)]);
  }
}

/** Return the pixel of a point of the object, metres; T is 4x4, row-major, from the object to the camera. */
function project(T, [fx, fy, cx, cy], x, y, z) {
  const [right, down, forward] = [0, 4, 8].map((row) => T[row] * x + T[row + 1] * y + T[row + 2] * z + T[row + 3]);
  return [cx + (fx * right) / forward, cy + (fy * down) / forward];
}

function line(colour, points) {
  drawing.strokeStyle = colour;
  drawing.beginPath();
  for (const point of points) drawing.lineTo(...point);
  drawing.stroke();
}

function tell({ reply, computeMs, queueMs, roundTripMs, server }, { encodeMs, jpegBytes, bytes }) {
  const metres = (value) => `${value.toFixed(3)} m`;
  const lines = reply.found.map(({ name, T_camera_object: T, rmse_px: error }) =>
    `${name}: right ${metres(T[3])}, down ${metres(T[7])}, ahead ${metres(T[11])}, error ${error.toFixed(2)} px`,
  );
  const cost = `${(bytes / 1e3).toFixed(1)} kB, ${roundTripMs.toFixed(0)} ms (computed in ${computeMs.toFixed(0)}) by ${server}`;
  shown.textContent = [...(lines.length ? lines : ["nothing that is known"]), cost].join("\n");
  const figures = { encodeMs, jpegBytes, bytes, computeMs, queueMs, roundTripMs };
  shown.dataset.found = JSON.stringify({ found: reply.found, figures });
}
