/** RSE-PF for browsers, web workers and Node. The rules of a session are in docs/protocol.md. */

/** Arrays of numbers, flat and row-major; typed arrays are accepted. */
export type Numbers = ArrayLike<number>;

export interface RobotOptions {
  /** The robot's token, or a function that returns a fresh token within 30 s for each connect and each renewal. */
  token?: string | (() => string | Promise<string>);
  /** How the token travels: as a sub-protocol (default), or as a header, which only Node can set. */
  tokenIn?: "protocol" | "header";
  /** Format of messages: `zlib` (JSON compressed by zlib, the default) or `json`. */
  codec?: "zlib" | "json";
  /** Name and version of the program, for the server's log. */
  sdk?: string;
  /**
   * Called with `link-lost` or `refused` and the reason, or with `link-back` or `moved` and the name of the server.
   * A robot that its servers refuse continues to reconnect. The first connect and `close` are not reported.
   */
  onChange?: (what: "link-lost" | "link-back" | "moved" | "refused", why: string) => void;
  /** Longest duration of an attempt, until the Welcome; default 4000. */
  connectTimeoutMs?: number;
  /** A connection with an unanswered command counts as lost if nothing arrives on it for this time; default 1000. */
  stallTimeoutMs?: number;
  /** Address of the data service, if it is not that of the servers. */
  dataUrl?: string;
  /** Class of WebSockets, for a runtime without a built-in class. */
  WebSocket?: unknown;
}

export interface CallOptions {
  /** Milliseconds within which the answer is needed; default 5000, or none for a long service. */
  deadlineMs?: number | null;
  /** Name of the camera or task: the newest command of a stream replaces older ones that wait. */
  stream?: string;
  /** Answer this command even if newer commands of its stream follow. */
  keep?: boolean;
  /** A word of at most 64 characters that is found in the server's log. */
  trace?: string;
  /** Called with the progress of a long service: completed share (0 to 1), current step. No default deadline then. */
  onProgress?: (done: number, what: string) => void;
  /** Cancels the command when it is aborted: the command ends with `cancelled`. */
  signal?: AbortSignal;
}

export interface Answer<Reply = any> {
  id: number;
  /** The service's reply; null if it was stored as an object. */
  reply: Reply;
  /** sha256 of a reply that was stored as an object, or "". */
  object: string;
  server: string;
  queueMs: number;
  computeMs: number;
  roundTripMs: number;
}

export interface Camera {
  fx: number;
  fy: number;
  cx: number;
  cy: number;
  width: number;
  height: number;
}

export interface PnpRequest {
  /** Intrinsics of the image in pixels; the centre of the first pixel is (0, 0). */
  camera: Camera;
  /** 3n numbers: metres, world frame; n from 4 to 5000. */
  pointsWorld: Numbers;
  /** 2n numbers: undistorted pixels of the same points. */
  pixels: Numbers;
  options?: {
    engine?: "native" | "opencv" | null;
    inlier_px?: number;
    max_iterations?: number;
    min_iterations?: number;
    confidence?: number;
  } | null;
  /** n depths in metres that a depth camera measured at the pixels, 0 where there is none. */
  depthsM?: Numbers;
  depthNoise?: { base_m?: number; growth_per_m?: number; from_m?: number };
}

export interface PnpReply {
  /** 16 numbers, row-major: maps world points into the camera's frame (x right, y down, z forward). */
  T_camera_world: number[];
  /** Sorted row numbers of the matches that are inliers. */
  inliers: number[];
  rmse_px: number;
  /** 21 numbers: upper triangle of the covariance of the twist (metres, then radians), left of the pose. */
  covariance: number[];
  verdict: "ok" | "weak";
  reason: string;
  engine: string;
}

export interface Stats {
  sent: number;
  /** Commands that ended with an answer. */
  answered: number;
  /** Commands that ended with an error. */
  failed: number;
  /** How often a command was sent again, after a lost connection or a failure of its server. */
  resent: number;
  reconnects: number;
  moves: number;
  /** Bytes of all WebSocket messages that were sent. */
  bytesOut: number;
  /** Bytes of all WebSocket messages that were received. */
  bytesIn: number;
  unanswered: number;
  /**
   * Commands that were not sent at once although there was a connection: by `busy` (the server's answer to this
   * command or another one of its stream) or `own-limit` (limits of the Welcome).
   */
  heldBack: { busy: number; "own-limit": number };
  /** Calls of the program's functions (callbacks and the token function) that threw or were rejected. */
  callbackErrors: number;
}

export interface Robot {
  /** Name of the server of the current connection, "" while there is none. */
  readonly server: string;
  /** Name of the robot, from its token. */
  readonly robot: string;
  /** The error with which every call fails after `close`; null before. */
  readonly error: RsePfError | null;
  /** Why all servers refuse this robot now: every call rejects with this error. Null while they do not. */
  readonly failure: RsePfError | null;
  readonly stats: Stats;
  /** Call a service; rejects with an RsePfError. */
  call<Reply = any>(service: string, payload?: unknown, options?: CallOptions): Promise<Answer<Reply>>;
  /** Estimate the pose of a camera; points are rounded to 0.1 mm and 0.01 px. */
  solvePnp(request: PnpRequest, options?: CallOptions): Promise<Answer<PnpReply>>;
  /** Subscribe to a topic, such as `live/MAP`, on this and all later connections; returns a function that unsubscribes. */
  subscribe(
    topic: string,
    onUpdate: (key: string, payload: any, seq: number) => void,
    onEnd?: (error: RsePfError) => void,
  ): () => void;
  /** Use a fresh token from now on; resolves when the server has accepted it, or at once without a connection. */
  renew(token: string): Promise<void>;
  /** Store bytes; resolves with their sha256 once they are durable. */
  upload(
    data: Uint8Array | ArrayBuffer,
    options?: { onProgress?: (done: number, size: number) => void; signal?: AbortSignal },
  ): Promise<string>;
  /** Return the bytes of an object of this robot, checked by their sha256. */
  download(digest: string, options?: { signal?: AbortSignal }): Promise<Uint8Array>;
  /** Close the connection; commands without an answer end with `disconnected`. */
  close(): void;
}

/** An error with a stable code of docs/protocol.md, section 5. */
export class RsePfError extends Error {
  constructor(code: string, message: string, hint?: string);
  readonly code: string;
  readonly hint: string;
  readonly retryAfterMs: number | null;
  readonly server: string;
  readonly trace: string;
}

/** Encoders and decoders of messages, by the name of the codec. */
export const codecs: Record<
  "json" | "zlib",
  {
    encode(text: string): string | Promise<Uint8Array>;
    decode(data: any): unknown;
  }
>;

/** Connect a robot, with a few attempts: `ws://HOST:PORT/ws`, or `wss:`. Rejects with an RsePfError. */
export function connect(url: string, options?: RobotOptions): Promise<Robot>;
