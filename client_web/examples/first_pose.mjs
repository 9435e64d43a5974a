// Connect, ask for the pose of a camera that sees 27 points of a grid, and print it.
// Arguments: the address of the platform and the token of a robot.
import { connect, RsePfError } from "../rse-pf.js";

const [url, token] = process.argv.slice(2);
if (!url) {
  console.log("usage: node first_pose.mjs ws://HOST:PORT/ws [TOKEN]");
  process.exit(2);
}

const camera = { fx: 525, fy: 525, cx: 319.5, cy: 239.5, width: 640, height: 480 };
const pointsWorld = [];
const pixels = [];
// The camera is at the origin of the world and looks along z, so its pose is the identity.
for (let at = 0; at < 27; at++) {
  const x = 0.4 * ((at % 3) - 1);
  const y = 0.3 * ((Math.floor(at / 3) % 3) - 1);
  const z = 2 + 0.3 * Math.floor(at / 9);
  pointsWorld.push(x, y, z);
  pixels.push(camera.cx + (camera.fx * x) / z, camera.cy + (camera.fy * y) / z);
}

try {
  const robot = await connect(url, { token });
  const { reply, server, roundTripMs } = await robot.solvePnp({ camera, pointsWorld, pixels });
  for (let row = 0; row < 4; row++) {
    console.log(reply.T_camera_world.slice(4 * row, 4 * row + 4).map((value) => value.toFixed(5)).join(" "));
  }
  console.log(`${reply.verdict}, ${reply.inliers.length} inliers, ${roundTripMs.toFixed(2)} ms by ${server}`);
  robot.close();
} catch (error) {
  if (!(error instanceof RsePfError)) throw error;
  console.error(`${error.code}: ${error.message}\n  hint: ${error.hint}`);
  process.exitCode = 1;
}
