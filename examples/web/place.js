// Localise this device's camera in a map by POST /localise/MAP, and draw where it is, seen from above.
// One photo is on its way at a time.

const WIDTH = 640;
const HEIGHT = 480;
const JPEG_QUALITY = 0.85;
const MARGIN_PX = 30;
// Within the rate of one robot, five photos a second.
const PAUSE_MS = 250;
// Another photo may be answered after these.
const PASSING = [408, 429, 503];

const form = document.forms[0];
const said = document.querySelector("output");
const canvas = document.querySelector("canvas");
const drawing = canvas.getContext("2d");
const video = document.createElement("video");
const frame = new OffscreenCanvas(WIDTH, HEIGHT);

// What stands behind the # of an address is sent to nobody.
for (const [name, value] of new URLSearchParams(location.hash.slice(1))) if (form[name]) form[name].value = value;
form.url.value ||= `${location.protocol}//${location.hostname}:8700`;

form.onsubmit = async (event) => {
  event.preventDefault();
  form.querySelector("button").disabled = true;
  try {
    await run();
  } catch (error) {
    said.textContent = error.message;
    form.querySelector("button").disabled = false;
  }
};

async function run() {
  said.textContent = "asking for the camera";
  if (!navigator.mediaDevices) throw new Error("browsers give the camera to https pages and to localhost only");
  const outline = await ask("GET");
  draw(outline);
  const wanted = { width: WIDTH, height: HEIGHT, facingMode: "environment" };
  video.srcObject = await navigator.mediaDevices.getUserMedia({ video: wanted });
  video.muted = video.playsInline = true;
  await video.play();
  for (;;) {
    const began = performance.now();
    const photo = await takePhoto();
    const found = await ask("POST", photo);
    if (found) show(found, outline, performance.now() - began);
    await new Promise((done) => setTimeout(done, PAUSE_MS));
  }
}

async function takePhoto() {
  await new Promise((done) => video.requestVideoFrameCallback(done));
  frame.getContext("2d").drawImage(video, 0, 0, WIDTH, HEIGHT);
  return frame.convertToBlob({ type: "image/jpeg", quality: JPEG_QUALITY });
}

/** Return what the platform answers; null if it only asks to wait. */
async function ask(method, body) {
  const focal = form.focal.value;
  const lens = new URLSearchParams({ fx: focal, fy: focal, cx: (WIDTH - 1) / 2, cy: (HEIGHT - 1) / 2 });
  const address = `${form.url.value}/localise/${encodeURIComponent(form.map.value)}${body ? `?${lens}` : ""}`;
  const reply = await fetch(address, { method, body, headers: { Authorization: `Bearer ${form.token.value}` } });
  if (reply.ok) return reply.json();
  // Not every proxy on the way answers errors in JSON.
  const { message, hint } = await reply.json().catch(() => ({ message: `the platform answers ${reply.status}` }));
  if (!body || !PASSING.includes(reply.status)) throw new Error(hint ? `${message} (${hint})` : message);
  said.textContent = message;
  return null;
}

function show(found, outline, tookMs) {
  const T = found.T_map_camera;
  const told = T ? `x ${T[0][3].toFixed(2)} y ${T[1][3].toFixed(2)} z ${T[2][3].toFixed(2)} m, ±${found.position_sigma_m.toFixed(2)} m` : "";
  said.textContent = `${found.verdict} ${found.reason} ${told} (${tookMs.toFixed(0)} ms)`;
  if (T) draw(outline, found);
  said.dataset.found = JSON.stringify(found);
}

/** Draw the map from above, and the camera: filled if its pose is ok. */
function draw({ keyframes, points, top_view: axes }, found) {
  const onMap = ([a, b, c]) => axes.map(([x, y, z]) => x * a + y * b + z * c);
  const shown = [...keyframes, ...points];
  const low = [0, 1].map((axis) => Math.min(...shown.map((place) => place[axis])));
  const high = [0, 1].map((axis) => Math.max(...shown.map((place) => place[axis])));
  const scale = (canvas.width - 2 * MARGIN_PX) / Math.max(high[0] - low[0], high[1] - low[1], 1);
  const middle = [0, 1].map((axis) => (low[axis] + high[axis]) / 2);
  const pixel = ([x, y]) => [canvas.width / 2 + (x - middle[0]) * scale, canvas.height / 2 - (y - middle[1]) * scale];
  drawing.clearRect(0, 0, canvas.width, canvas.height);
  drawing.fillStyle = "#9ab";
  for (const place of points) drawing.fillRect(...pixel(place), 2, 2);
  drawing.fillStyle = "#06c";
  for (const place of keyframes) drawing.fillRect(...pixel(place), 4, 4);
  if (!found) return;
  const column = (at) => found.T_map_camera.slice(0, 3).map((row) => row[at]);
  const [at, ahead] = [onMap(column(3)), onMap(column(2))];
  const [x, y] = pixel(at);
  drawing.strokeStyle = drawing.fillStyle = "#d33";
  drawing.lineWidth = 3;
  drawing.beginPath();
  drawing.arc(x, y, 8, 0, 2 * Math.PI);
  if (found.verdict === "ok") drawing.fill();
  drawing.moveTo(x, y);
  drawing.lineTo(x + 30 * ahead[0], y - 30 * ahead[1]);
  drawing.stroke();
  said.dataset.drawn = JSON.stringify([x, y]);
}
