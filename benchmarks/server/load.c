/* Load a WebSocket server on loopback from one thread, and print the outcome as one JSON object.

   benchmarks/server/load.py compiles it and writes its payload files; `load --help` prints the options.

   Every robot of a group sends along times that are fixed before the run (open loop: one rate, a uniform
   random phase each, from a seed), or as soon as it is answered (closed loop).  Both loops begin when all
   robots are connected; an early group is an open loop that begins at once, such as the pings of robots that
   wait for others.  In an open loop, latency counts from the planned time, so a server that stalls cannot
   hide it; the delay with which this program itself sent is reported separately.

   Answers are matched by their `id`: message k of a payload file has the id k.  An answer without id belongs
   to the oldest unanswered message of its connection.

   With --obey 1 a robot that receives `retry_after_ms` sends nothing for that time; the messages that it
   leaves out count as unsent, and so as offered.

   The program connects to 127.0.0.0/8 only, exits at a deadline in any case, and does not check poses. */
#define _GNU_SOURCE
#include <arpa/inet.h>
#include <ctype.h>
#include <errno.h>
#include <math.h>
#include <netinet/tcp.h>
#include <poll.h>
#include <signal.h>
#include <stdarg.h>
#include <stdbool.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/epoll.h>
#include <sys/prctl.h>
#include <sys/resource.h>
#include <sys/socket.h>
#include <time.h>
#include <unistd.h>
#include <zlib.h>

enum {
  MAX_GROUPS = 8,
  MAX_FRAMES = 1024,
  MAX_QUEUED = 8,             /* most frames that wait for one connection; more are not sent */
  MAX_MESSAGE = 1 << 20,      /* bytes of the longest message of a server */
  MAX_CODES = 64,
  HEAD_BYTES = 160,           /* type and id of an answer stand within these first bytes */
  EVENTS = 1024,
};

static const char USAGE[] =
    "load --port PORT --group NAME:ROBOTS:MODE:RATE:FILE [--group ...] [options]\n"
    "  MODE is open, early or closed; RATE counts per robot and second; FILE holds the\n"
    "  messages, each after its length (u32, little endian), and - stands for none\n"
    "  --address 127.0.0.1 --path /ws --subprotocol NAME --tokens FILE --hello FILE\n"
    "  --sources 1 --first-source 1   source addresses 127.0.0.N of the connections, in turn\n"
    "  --reply none|json|zlib|msgpack|peer   how answers are read\n"
    "  --seconds 5 --warm-up 0.5 --drain 4 --opening 60   the window, before it, after it, to connect\n"
    "  --at-once 64   connections that open at the same time\n"
    "  --join-every 0   pause between two robots that connect\n"
    "  --obey 0   1: wait as long as a failure says\n"
    "  --seed 1 --samples FILE\n";

typedef enum { OPEN_LOOP, EARLY_LOOP, CLOSED_LOOP } Mode;
typedef enum { REPLY_NONE, REPLY_JSON, REPLY_ZLIB, REPLY_MSGPACK, REPLY_PEER } ReplyKind;
typedef enum { ABSENT, CONNECTING, UPGRADING, WELCOMING, READY } State;
typedef enum { OK, FAILED, LOST, UNSENT } Outcome;
typedef enum { ANSWER_OK, ANSWER_FAILED, NO_ANSWER } Answer;

typedef struct {
  uint8_t *bytes;
  size_t size;
} Frame;

typedef struct {
  float *values;
  size_t count, capacity;
} Floats;

typedef struct {
  char name[32];
  Mode mode;
  int robots, first; /* number of robots of the group, and index of its first robot */
  double rate, begin_s; /* messages a second of a robot, and when its first turn may begin */
  Frame *frames;
  int frame_count;
  int *order; /* robots of the group, by phase */
  double *phase_s;
  uint64_t turn;    /* sends planned so far, over all robots */
  double *planned; /* of each robot and message: planned send time, 0 if it was not sent or is answered */
  Floats latency_s, late_s;
  uint64_t outcomes[4];
  uint64_t answered_in_window;
} Group;

typedef struct {
  int fd;
  State state;
  Group *group;
  int next_frame, unanswered;
  uint16_t queue[MAX_QUEUED];
  int queued;
  size_t offset; /* bytes of queue[0] that have been sent */
  bool says_hello, waits_for_room, is_settled;
  uint8_t *partial;
  size_t partial_size, partial_capacity;
  double opens_s, silent_until_s;
} Robot;

typedef struct {
  char name[32];
  uint64_t count;
} Counted;

typedef struct __attribute__((packed)) {
  double planned_s;
  float latency_s, late_s;
  uint32_t group, outcome;
} Sample;

static struct {
  struct sockaddr_in address;
  const char *path, *subprotocol;
  int sources, first_source, at_once;
  double seconds, warm_up_s, drain_s, opening_s, join_every_s;
  unsigned seed;
  bool obeys;
  ReplyKind reply;
  FILE *samples;
} option;

static Group groups[MAX_GROUPS];
static int group_count;
static Robot *robots;
static int robot_count;
static char **tokens;
static int token_count;
static Frame *hello;
static int poller;
static double begin_s, first_s = INFINITY, last_s = INFINITY; /* the window is [first_s, last_s) */
static int opening, ready_count;
static int settled; /* number of robots that have been connected once, or were given up */
static int *waiting; /* robots that have to connect: a ring buffer in the order of time */
static int waiting_head, waiting_count;
static uint64_t refused[600], unmatched;
static Counted closed_by[MAX_CODES], codes[MAX_CODES];
static volatile sig_atomic_t stop_asked;
static z_stream inflater;

static void fail(const char *format, ...) {
  va_list arguments;
  va_start(arguments, format);
  fputs("load: ", stderr);
  vfprintf(stderr, format, arguments);
  fputc('\n', stderr);
  va_end(arguments);
  exit(2);
}

static double now_s(void) {
  struct timespec time;
  clock_gettime(CLOCK_MONOTONIC, &time);
  return (double)time.tv_sec + 1e-9 * (double)time.tv_nsec;
}

static double own_cpu_s(void) {
  struct timespec time;
  clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &time);
  return (double)time.tv_sec + 1e-9 * (double)time.tv_nsec;
}

static void *allocated(size_t count, size_t size) {
  void *made = calloc(count ? count : 1, size);
  if (!made) fail("out of memory");
  return made;
}

static void append(Floats *to, double value) {
  if (to->count == to->capacity) {
    to->capacity = to->capacity ? 2 * to->capacity : 4096;
    to->values = realloc(to->values, to->capacity * sizeof *to->values);
    if (!to->values) fail("out of memory");
  }
  to->values[to->count++] = (float)value;
}

static void count(Counted *table, const char *name, size_t size) {
  for (size_t i = 0; i < size; i++)
    if (!isalnum((unsigned char)name[i]) && name[i] != '-') return;
  for (int i = 0; i < MAX_CODES; i++) {
    if (!table[i].count) snprintf(table[i].name, sizeof table[i].name, "%.*s", (int)size, name);
    if (strlen(table[i].name) == size && !memcmp(table[i].name, name, size)) {
      table[i].count++;
      return;
    }
  }
}

/* Random phases: splitmix64, so that a seed gives the same times everywhere. */
static double uniform(uint64_t *state) {
  uint64_t z = (*state += 0x9e3779b97f4a7c15u);
  z = (z ^ (z >> 30)) * 0xbf58476d1ce4e5b9u;
  z = (z ^ (z >> 27)) * 0x94d049bb133111ebu;
  return (double)((z ^ (z >> 31)) >> 11) * 0x1p-53;
}

/* ---- files ---- */

static Frame framed(const uint8_t *payload, size_t size, int opcode) {
  static const uint8_t mask[4] = {0x5a, 0xa7, 0x3c, 0xd1};
  Frame made = {allocated(size + 14, 1), 0};
  uint8_t *to = made.bytes;
  *to++ = (uint8_t)(0x80 | opcode);
  if (size < 126) {
    *to++ = (uint8_t)(0x80 | size);
  } else if (size < 65536) {
    *to++ = 0x80 | 126;
    *to++ = (uint8_t)(size >> 8);
    *to++ = (uint8_t)size;
  } else {
    *to++ = 0x80 | 127;
    for (int shift = 56; shift >= 0; shift -= 8) *to++ = (uint8_t)((uint64_t)size >> shift);
  }
  memcpy(to, mask, 4);
  to += 4;
  for (size_t i = 0; i < size; i++) *to++ = payload[i] ^ mask[i & 3];
  made.size = (size_t)(to - made.bytes);
  return made;
}

static Frame *read_frames(const char *file, int opcode, int *frame_count) {
  FILE *stream = fopen(file, "rb");
  if (!stream) fail("cannot read %s", file);
  Frame *made = allocated(MAX_FRAMES, sizeof *made);
  uint8_t length[4];
  int n = 0;
  while (fread(length, 1, 4, stream) == 4) {
    size_t size = length[0] | (size_t)length[1] << 8 | (size_t)length[2] << 16 | (size_t)length[3] << 24;
    uint8_t *payload = allocated(size, 1);
    if (n == MAX_FRAMES || fread(payload, 1, size, stream) != size)
      fail("%s: message %d is cut off, or one too many (%d)", file, n, MAX_FRAMES);
    made[n++] = framed(payload, size, opcode);
    free(payload);
  }
  fclose(stream);
  if (!n) fail("%s holds no message", file);
  *frame_count = n;
  return made;
}

static void read_tokens(const char *file) {
  FILE *stream = fopen(file, "r");
  if (!stream) fail("cannot read %s", file);
  char *line = NULL;
  size_t capacity = 0;
  ssize_t length;
  int room = 0;
  while ((length = getline(&line, &capacity, stream)) > 0) {
    while (length && (line[length - 1] == '\n' || line[length - 1] == '\r')) line[--length] = 0;
    if (token_count == room) tokens = realloc(tokens, sizeof *tokens * (size_t)(room = room ? 2 * room : 64));
    if (!tokens || !(tokens[token_count++] = strdup(line))) fail("out of memory");
  }
  free(line);
  fclose(stream);
}

/* ---- outcomes ---- */

static bool in_window(double planned_s) { return planned_s >= first_s && planned_s < last_s; }

static void note(Group *group, Outcome outcome, double planned_s, double latency_s, double late_s) {
  if (!in_window(planned_s)) return;
  group->outcomes[outcome]++;
  if (outcome == OK || outcome == FAILED) append(&group->latency_s, latency_s);
  if (option.samples) {
    Sample sample = {planned_s, (float)latency_s, (float)late_s, (uint32_t)(group - groups), outcome};
    fwrite(&sample, sizeof sample, 1, option.samples);
  }
}

static double *planned_of(Robot *robot) {
  Group *group = robot->group;
  return group->planned + (size_t)(robot - robots - group->first) * (size_t)group->frame_count;
}

static void lose_unanswered(Robot *robot) {
  if (!robot->unanswered) return;
  double *planned = planned_of(robot);
  for (int i = 0; i < robot->group->frame_count; i++) {
    if (planned[i]) note(robot->group, LOST, planned[i], NAN, NAN);
    planned[i] = 0;
  }
  robot->unanswered = 0;
}

/* ---- connections ---- */

static void wait_to_open(Robot *robot, double at_s) {
  robot->opens_s = at_s;
  waiting[(waiting_head + waiting_count++) % robot_count] = (int)(robot - robots);
}

static void settle(Robot *robot) {
  settled += !robot->is_settled;
  robot->is_settled = true;
}

static void end(Robot *robot, const char *why) {
  count(closed_by, why, strlen(why));
  if (robot->state == READY)
    ready_count--;
  else
    opening--;
  close(robot->fd);
  lose_unanswered(robot);
  robot->state = ABSENT;
  robot->queued = 0;
  robot->offset = robot->partial_size = 0;
  robot->waits_for_room = robot->says_hello = false;
  settle(robot);
}

static void watch(Robot *robot, bool for_room) {
  if (for_room == robot->waits_for_room) return;
  struct epoll_event event = {EPOLLIN | (for_room ? EPOLLOUT : 0), {.ptr = robot}};
  epoll_ctl(poller, EPOLL_CTL_MOD, robot->fd, &event);
  robot->waits_for_room = for_room;
}

static void flush(Robot *robot) {
  while (robot->queued || robot->says_hello) {
    Frame *frame = robot->says_hello ? hello : &robot->group->frames[robot->queue[0]];
    ssize_t sent = send(robot->fd, frame->bytes + robot->offset, frame->size - robot->offset, MSG_NOSIGNAL);
    if (sent < 0 && errno == EINTR) continue;
    if (sent < 0 && (errno == EAGAIN || errno == EWOULDBLOCK)) break;
    if (sent < 0) {
      end(robot, "broken");
      return;
    }
    robot->offset += (size_t)sent;
    if (robot->offset < frame->size) break;
    robot->offset = 0;
    if (robot->says_hello) {
      robot->says_hello = false;
    } else {
      robot->queued--;
      memmove(robot->queue, robot->queue + 1, sizeof *robot->queue * (size_t)robot->queued);
    }
  }
  watch(robot, robot->queued > 0 || robot->says_hello);
}

static void send_next(Robot *robot, double planned_s) {
  Group *group = robot->group;
  double now = now_s();
  if (robot->state != READY || robot->queued == MAX_QUEUED || now < robot->silent_until_s) {
    note(group, UNSENT, planned_s, NAN, NAN);
    return;
  }
  double *planned = planned_of(robot), late_s = now_s() - planned_s;
  int k = robot->next_frame;
  robot->next_frame = (k + 1) % group->frame_count;
  if (planned[k]) {
    note(group, LOST, planned[k], NAN, NAN); /* the id is used again by a later message */
    robot->unanswered--;
  }
  planned[k] = planned_s;
  robot->unanswered++;
  if (group->mode <= EARLY_LOOP && in_window(planned_s)) append(&group->late_s, late_s);
  robot->queue[robot->queued++] = (uint16_t)k;
  if (robot->queued == 1) flush(robot);
}

static void become_ready(Robot *robot) {
  robot->state = READY;
  opening--;
  ready_count++;
  settle(robot);
  if (robot->group->mode == CLOSED_LOOP && first_s < INFINITY) send_next(robot, now_s());
}

static void connect_robot(Robot *robot) {
  static const int one = 1;
  int number = (int)(robot - robots);
  robot->fd = socket(AF_INET, SOCK_STREAM | SOCK_NONBLOCK | SOCK_CLOEXEC, 0);
  if (robot->fd < 0) fail("no socket: %s", strerror(errno));
  setsockopt(robot->fd, IPPROTO_TCP, TCP_NODELAY, &one, sizeof one);
  setsockopt(robot->fd, IPPROTO_IP, IP_BIND_ADDRESS_NO_PORT, &one, sizeof one);
  struct sockaddr_in source = {.sin_family = AF_INET};
  source.sin_addr.s_addr = htonl(0x7f000000u + (uint32_t)(option.first_source + number % option.sources));
  if (bind(robot->fd, (struct sockaddr *)&source, sizeof source)) fail("bind: %s", strerror(errno));
  int result = connect(robot->fd, (struct sockaddr *)&option.address, sizeof option.address);
  robot->state = CONNECTING;
  opening++;
  robot->waits_for_room = true;
  struct epoll_event event = {EPOLLIN | EPOLLOUT, {.ptr = robot}};
  if (epoll_ctl(poller, EPOLL_CTL_ADD, robot->fd, &event)) fail("epoll: %s", strerror(errno));
  if (result && errno != EINPROGRESS) end(robot, "unreachable");
}

static void upgrade(Robot *robot) {
  char head[4096];
  int number = (int)(robot - robots), failure = 0;
  socklen_t failure_size = sizeof failure;
  getsockopt(robot->fd, SOL_SOCKET, SO_ERROR, &failure, &failure_size);
  if (failure) {
    end(robot, "unreachable");
    return;
  }
  watch(robot, false);
  int size = snprintf(head, sizeof head,
                      "GET %s HTTP/1.1\r\nHost: 127.0.0.1\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
                      "Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: AQIDBAUGBwgJCgsMDQ4PEA==\r\n"
                      "%s%s%s%s%s%s\r\n",
                      option.path, option.subprotocol ? "Sec-WebSocket-Protocol: " : "",
                      option.subprotocol ? option.subprotocol : "", option.subprotocol ? "\r\n" : "",
                      token_count ? "Authorization: Bearer " : "",
                      token_count ? tokens[number % token_count] : "", token_count ? "\r\n" : "");
  robot->state = UPGRADING;
  if (size >= (int)sizeof head || send(robot->fd, head, (size_t)size, MSG_NOSIGNAL) != size)
    end(robot, "broken");
}

static void open_waiting(double now) {
  while (waiting_count && opening < option.at_once && robots[waiting[waiting_head]].opens_s <= now) {
    Robot *robot = &robots[waiting[waiting_head]];
    waiting_head = (waiting_head + 1) % robot_count;
    waiting_count--;
    connect_robot(robot);
  }
}

/* ---- answers ---- */

static const uint8_t *after(const uint8_t *data, size_t size, const char *mark, size_t mark_size) {
  const uint8_t *found = memmem(data, size, mark, mark_size);
  return found ? found + mark_size : NULL;
}

static size_t inflated(const uint8_t *data, size_t size, uint8_t *to, size_t room) {
  if (inflateReset(&inflater) != Z_OK) return 0;
  inflater.next_in = (Bytef *)(uintptr_t)data;
  inflater.avail_in = (uInt)size;
  inflater.next_out = to;
  inflater.avail_out = (uInt)room;
  int result = inflate(&inflater, Z_SYNC_FLUSH);
  return result == Z_OK || result == Z_STREAM_END || result == Z_BUF_ERROR ? room - inflater.avail_out : 0;
}

static Answer kind_of(const uint8_t *type, size_t size) {
  if (size == 6 && !memcmp(type, "result", 6)) return ANSWER_OK;
  if (size == 4 && !memcmp(type, "pong", 4)) return ANSWER_OK;
  if (size == 7 && !memcmp(type, "failure", 7)) return ANSWER_FAILED;
  return NO_ANSWER;
}

/* Count the code of a failure, in text or in MessagePack. */
static void count_code(const uint8_t *data, size_t size) {
  const uint8_t *over = data + size, *at;
  if (option.reply == REPLY_MSGPACK) {
    at = after(data, size, "\xa4" "code", 5);
    if (at && at < over && (*at & 0xe0) == 0xa0 && at + 1 + (*at & 31) <= over)
      count(codes, (const char *)at + 1, *at & 31);
    return;
  }
  at = after(data, size, "\"code\":\"", 8);
  const uint8_t *quote = at ? memchr(at, '"', (size_t)(over - at)) : NULL;
  if (quote) count(codes, (const char *)at, (size_t)(quote - at));
}

/* Read type and id of a JSON message; *id stays -1 in a message without an id. */
static Answer read_json(const uint8_t *data, size_t size, bool is_peer, long *id) {
  const uint8_t *over = data + size, *at = after(data, size, "\"id\":", 5);
  if (at && at < over && *at >= '0' && *at <= '9') {
    *id = 0;
    for (; at < over && *at >= '0' && *at <= '9' && *id < MAX_FRAMES; at++) *id = 10 * *id + (*at - '0');
  }
  if (is_peer) return after(data, size, "\"ok\":true", 9) ? ANSWER_OK : ANSWER_FAILED;
  at = after(data, size, "\"type\":\"", 8);
  const uint8_t *quote = at ? memchr(at, '"', (size_t)(over - at)) : NULL;
  Answer answer = quote ? kind_of(at, (size_t)(quote - at)) : NO_ANSWER;
  if (answer == ANSWER_FAILED) count_code(data, size);
  return answer;
}

/* Read type and id of a MessagePack map whose strings are short; *id stays -1 without an id. */
static Answer read_msgpack(const uint8_t *data, size_t size, long *id) {
  const uint8_t *over = data + size, *at = after(data, size, "\xa2id", 3);
  if (at && at < over) {
    if (*at < 0x80)
      *id = *at;
    else if (*at == 0xcc && at + 1 < over)
      *id = at[1];
    else if (*at == 0xcd && at + 2 < over)
      *id = at[1] << 8 | at[2];
  }
  at = after(data, size, "\xa4type", 5);
  if (!at || at >= over || (*at & 0xe0) != 0xa0 || at + 1 + (*at & 31) > over) return NO_ANSWER;
  Answer answer = kind_of(at + 1, *at & 31);
  if (answer == ANSWER_FAILED) count_code(data, size);
  return answer;
}

/* Return a whole message, as inflated text or as MessagePack, and its size in *size; for rare messages. */
static const uint8_t *whole(const uint8_t *data, size_t *size) {
  static uint8_t text[8192];
  if (option.reply == REPLY_MSGPACK) return data;
  size_t length = option.reply == REPLY_ZLIB ? inflated(data, *size, text, sizeof text - 1) : 0;
  if (option.reply == REPLY_JSON) memcpy(text, data, length = *size < sizeof text ? *size : sizeof text - 1);
  text[*size = length] = 0;
  return text;
}

/* Return the number with a name (below 32 letters) in a `whole` message; 0 if there is none. */
static double number_of(const uint8_t *text, size_t size, const char *name) {
  char mark[40];
  bool is_text = option.reply != REPLY_MSGPACK;
  int length = is_text ? snprintf(mark, sizeof mark, "\"%s\":", name)
                       : snprintf(mark, sizeof mark, "%c%s\xcb", (int)(0xa0 | strlen(name)), name);
  const uint8_t *at = after(text, size, mark, (size_t)length);
  if (is_text) return at ? strtod((const char *)at, NULL) : 0;
  if (!at || at + 8 > text + size) return 0;
  uint64_t bits = 0;
  for (int i = 0; i < 8; i++) bits = bits << 8 | at[i];
  double value;
  memcpy(&value, &bits, sizeof value);
  return value;
}

static Answer read_answer(const uint8_t *data, size_t size, long *id) {
  static uint8_t text[8192];
  switch (option.reply) {
    case REPLY_NONE:
      return ANSWER_OK;
    case REPLY_MSGPACK:
      return read_msgpack(data, size < HEAD_BYTES ? size : HEAD_BYTES, id);
    case REPLY_JSON:
      return read_json(data, size < HEAD_BYTES ? size : HEAD_BYTES, false, id);
    case REPLY_ZLIB:
      return read_json(text, inflated(data, size, text, HEAD_BYTES), false, id);
    default: /* the order of the peer's fields is random */
      return read_json(text, inflated(data, size, text, sizeof text), true, id);
  }
}

/* Record the end of message *id*, or of the oldest unanswered message if *id* is -1. */
static void take_end(Robot *robot, long id, Outcome outcome, double at_s) {
  Group *group = robot->group;
  double *planned = group->frame_count ? planned_of(robot) : NULL;
  if (id < 0 && robot->unanswered) {
    for (int i = 0; i < group->frame_count; i++)
      if (planned[i] && (id < 0 || planned[i] < planned[id])) id = i;
  }
  if (id < 0 || id >= group->frame_count || !planned[id]) {
    unmatched++;
    return;
  }
  note(group, outcome, planned[id], at_s - planned[id], NAN);
  if (in_window(at_s)) group->answered_in_window++;
  planned[id] = 0;
  robot->unanswered--;
  if (group->mode == CLOSED_LOOP && at_s < last_s && !stop_asked) send_next(robot, now_s());
}

static void take_answer(Robot *robot, const uint8_t *data, size_t size, double at_s) {
  long id = -1;
  Answer answer = read_answer(data, size, &id);
  if (answer == NO_ANSWER) return;
  if (option.obeys && answer != ANSWER_OK) {
    size_t length = size;
    const uint8_t *text = whole(data, &length);
    robot->silent_until_s = at_s + 1e-3 * number_of(text, length, "retry_after_ms");
  }
  take_end(robot, id, answer == ANSWER_OK ? OK : FAILED, at_s);
}

static void take_frame(Robot *robot, int opcode, const uint8_t *data, size_t size, double at_s) {
  if (opcode == 8) {
    char code[8];
    snprintf(code, sizeof code, "%d", size >= 2 ? data[0] << 8 | data[1] : 1005);
    end(robot, code);
  } else if (opcode == 9 && size < 126 && !robot->offset) {
    uint8_t pong[131] = {0x8a, (uint8_t)(0x80 | size)};
    memcpy(pong + 6, data, size);
    if (send(robot->fd, pong, size + 6, MSG_NOSIGNAL) < 0) end(robot, "broken");
  } else if (opcode < 3 && robot->state == WELCOMING) {
    become_ready(robot);
  } else if (opcode < 3) {
    take_answer(robot, data, size, at_s);
  }
}

/* Process the answer to the handshake; return the bytes used, 0 if the answer is incomplete. */
static size_t take_head(Robot *robot, const uint8_t *data, size_t size) {
  const uint8_t *rest = after(data, size, "\r\n\r\n", 4);
  if (!rest) {
    if (size > 16384) end(robot, "no-handshake");
    return 0;
  }
  int status = size > 12 && !memcmp(data, "HTTP/1.1 ", 9) ? atoi((const char *)data + 9) : 0;
  if (status != 101) {
    refused[status >= 0 && status < 600 ? status : 0]++;
    end(robot, "refused");
    return 0;
  }
  if (hello) {
    robot->state = WELCOMING;
    robot->says_hello = true;
    flush(robot);
  } else {
    become_ready(robot);
  }
  return (size_t)(rest - data);
}

/* Process every complete frame; return the bytes used. */
static size_t take_frames(Robot *robot, const uint8_t *data, size_t size, double at_s) {
  size_t used = 0;
  while (robot->state >= UPGRADING) {
    const uint8_t *at = data + used;
    size_t left = size - used, head = 2;
    if (robot->state == UPGRADING) {
      size_t taken = take_head(robot, at, left);
      if (!taken) break;
      used += taken;
      continue;
    }
    if (left < 2) break;
    uint64_t length = at[1] & 127;
    if (length >= 126) head = length == 126 ? 4 : 10;
    if (left < head) break;
    if (head > 2) {
      length = 0;
      for (size_t i = 2; i < head; i++) length = length << 8 | at[i];
    }
    if (length > MAX_MESSAGE) {
      end(robot, "too-long");
      break;
    }
    if (left < head + length) break;
    used += head + length;
    take_frame(robot, at[0] & 15, at + head, length, at_s);
  }
  return used;
}

static void keep(Robot *robot, const uint8_t *data, size_t size) {
  if (robot->partial_size + size > robot->partial_capacity) {
    robot->partial_capacity = robot->partial_size + size;
    robot->partial = realloc(robot->partial, robot->partial_capacity);
    if (!robot->partial) fail("out of memory");
  }
  memcpy(robot->partial + robot->partial_size, data, size);
  robot->partial_size += size;
}

static void receive(Robot *robot) {
  static uint8_t buffer[1 << 16];
  ssize_t size = recv(robot->fd, buffer, sizeof buffer, 0);
  double at_s = now_s();
  if (size < 0 && (errno == EAGAIN || errno == EINTR)) return;
  if (size <= 0) {
    end(robot, size ? "reset" : "cut");
    return;
  }
  if (robot->state < UPGRADING) return;
  if (!robot->partial_size) {
    size_t used = take_frames(robot, buffer, (size_t)size, at_s);
    if (robot->state != ABSENT && used < (size_t)size) keep(robot, buffer + used, (size_t)size - used);
    return;
  }
  keep(robot, buffer, (size_t)size);
  size_t used = take_frames(robot, robot->partial, robot->partial_size, at_s);
  if (robot->state == ABSENT) return;
  robot->partial_size -= used;
  memmove(robot->partial, robot->partial + used, robot->partial_size);
  if (!robot->partial_size) {
    free(robot->partial);
    robot->partial = NULL;
    robot->partial_capacity = 0;
  }
}

/* ---- time ---- */

static double next_send_s(const Group *group) {
  if (group->mode > EARLY_LOOP || !group->robots) return INFINITY;
  uint64_t n = (uint64_t)group->robots;
  double phase_s = group->phase_s[group->order[group->turn % n]];
  return group->begin_s + (double)(group->turn / n) / group->rate + phase_s;
}

static void send_due(double now) {
  for (Group *group = groups; group < groups + group_count; group++) {
    double planned_s;
    while ((planned_s = next_send_s(group)) <= now && planned_s < last_s) {
      Robot *robot = &robots[group->first + group->order[group->turn % (uint64_t)group->robots]];
      group->turn++;
      if (robot->state == READY || planned_s >= first_s) send_next(robot, planned_s);
    }
  }
}

static double next_event_s(double now) {
  double next = first_s == INFINITY ? now + 0.05 : now < first_s ? first_s : last_s;
  for (int i = 0; i < group_count; i++) next = fmin(next, fmin(next_send_s(&groups[i]), last_s));
  if (waiting_count && opening < option.at_once) next = fmin(next, robots[waiting[waiting_head]].opens_s);
  return next;
}

/* Begin the groups that waited until all robots were connected, and set the measured window. */
static void begin_loops(double now) {
  first_s = now + option.warm_up_s;
  last_s = first_s + option.seconds;
  for (int i = 0; i < group_count; i++) groups[i].begin_s = fmin(groups[i].begin_s, now);
  for (Robot *robot = robots; robot < robots + robot_count; robot++)
    if (robot->state == READY && robot->group->mode == CLOSED_LOOP) send_next(robot, now);
}

/* Wait for sockets until a time with microseconds, since epoll_wait has only milliseconds. */
static void take_events(double until_s) {
  static struct epoll_event events[EVENTS];
  double pause_s = fmin(fmax(until_s - now_s(), 0), 0.05);
  struct timespec pause = {0, (long)(1e9 * pause_s)};
  struct pollfd polled = {poller, POLLIN, 0};
  if (ppoll(&polled, 1, &pause, NULL) < 1) return;
  int n = epoll_wait(poller, events, EVENTS, 0);
  for (int i = 0; i < n; i++) {
    Robot *robot = events[i].data.ptr;
    if (robot->state == CONNECTING) {
      if (events[i].events & (EPOLLOUT | EPOLLERR | EPOLLHUP)) upgrade(robot);
      continue;
    }
    if (robot->state != ABSENT && (events[i].events & EPOLLOUT)) flush(robot);
    if (robot->state != ABSENT && (events[i].events & (EPOLLIN | EPOLLERR | EPOLLHUP))) receive(robot);
  }
}

static bool is_answered(void) {
  for (int i = 0; i < robot_count; i++)
    if (robots[i].unanswered) return false;
  return true;
}

/* ---- report ---- */

static int by_value(const void *a, const void *b) {
  float x = *(const float *)a, y = *(const float *)b;
  return (x > y) - (x < y);
}

static void print_ms(const char *name, Floats *of) {
  static const double shares[] = {0.5, 0.95, 0.99, 0.999, 1.0};
  static const char *const names[] = {"p50", "p95", "p99", "p999", "max"};
  qsort(of->values, of->count, sizeof *of->values, by_value);
  printf("\"%s\":{\"n\":%zu", name, of->count);
  for (int i = 0; i < 5; i++) {
    if (of->count)
      printf(",\"%s\":%.4f", names[i], 1e3 * of->values[(size_t)(shares[i] * (double)(of->count - 1))]);
    else
      printf(",\"%s\":null", names[i]);
  }
  printf("}");
}

static void print_counted(const char *name, const Counted *table) {
  printf("\"%s\":{", name);
  for (int i = 0; i < MAX_CODES && table[i].count; i++)
    printf("%s\"%s\":%llu", i ? "," : "", table[i].name, (unsigned long long)table[i].count);
  printf("}");
}

static void print_report(double opened_s, double cpu_s, bool is_late) {
  printf("{\"robots\":%d,\"connected\":%d,\"opening_s\":%.3f,\"window_s\":[%.6f,%.6f],\"cpu_s\":%.4f,"
         "\"timed_out\":%s,\"unmatched\":%llu,\"refused\":{",
         robot_count, ready_count, opened_s, first_s, last_s, cpu_s, is_late ? "true" : "false",
         (unsigned long long)unmatched);
  const char *comma = "";
  for (int i = 0; i < 600; i++) {
    if (!refused[i]) continue;
    printf("%s\"%d\":%llu", comma, i, (unsigned long long)refused[i]);
    comma = ",";
  }
  printf("},");
  print_counted("closed", closed_by);
  printf(",");
  print_counted("codes", codes);
  printf(",\"groups\":[");
  for (int i = 0; i < group_count; i++) {
    Group *group = &groups[i];
    printf("%s{\"name\":\"%s\",\"robots\":%d,\"ok\":%llu,\"failed\":%llu,\"lost\":%llu,\"unsent\":%llu,"
           "\"answered_in_window\":%llu,",
           i ? "," : "", group->name, group->robots, (unsigned long long)group->outcomes[OK],
           (unsigned long long)group->outcomes[FAILED], (unsigned long long)group->outcomes[LOST],
           (unsigned long long)group->outcomes[UNSENT], (unsigned long long)group->answered_in_window);
    print_ms("latency_ms", &group->latency_s);
    printf(",");
    print_ms("late_ms", &group->late_s);
    printf("}");
  }
  printf("]}\n");
}

/* ---- options ---- */

static double *phases; /* phases of the group that is being sorted */

static int by_phase(const void *a, const void *b) {
  double x = phases[*(const int *)a], y = phases[*(const int *)b];
  return (x > y) - (x < y);
}

static void read_group(const char *text) {
  char mode[16], file[4096];
  if (group_count == MAX_GROUPS) fail("more than %d groups", MAX_GROUPS);
  Group *group = &groups[group_count++];
  if (sscanf(text, "%31[a-z0-9-]:%d:%15[a-z]:%lf:%4095[^\n]", group->name, &group->robots, mode, &group->rate,
             file) != 5)
    fail("--group takes NAME:ROBOTS:MODE:RATE:FILE, not %s", text);
  static const char *const modes[] = {"open", "early", "closed"};
  int number = 0;
  while (number < 3 && strcmp(mode, modes[number])) number++;
  group->mode = (Mode)number;
  if (number == 3 || group->robots < 0 || group->robots > 100000) fail("no such group: %s", text);
  if (group->mode <= EARLY_LOOP && !(group->rate > 0)) fail("an open loop needs a rate: %s", text);
  group->frames = read_frames(file, option.reply == REPLY_JSON ? 1 : 2, &group->frame_count);
  group->first = robot_count;
  robot_count += group->robots;
}

static void prepare_groups(void) {
  uint64_t random = option.seed;
  robots = allocated((size_t)robot_count, sizeof *robots);
  waiting = allocated((size_t)robot_count, sizeof *waiting);
  for (int i = 0; i < group_count; i++) {
    Group *group = &groups[i];
    size_t n = (size_t)group->robots;
    group->begin_s = group->mode == EARLY_LOOP ? begin_s : INFINITY;
    group->planned = allocated(n * (size_t)group->frame_count, sizeof *group->planned);
    group->phase_s = allocated(n, sizeof *group->phase_s);
    group->order = allocated(n, sizeof *group->order);
    for (int k = 0; k < group->robots; k++) {
      Robot *robot = &robots[group->first + k];
      robot->group = group;
      robot->next_frame = group->frame_count ? 7 * k % group->frame_count : 0;
      group->order[k] = k;
      group->phase_s[k] = group->rate > 0 ? uniform(&random) / group->rate : 0;
      wait_to_open(robot, begin_s + option.join_every_s * (group->first + k));
    }
    phases = group->phase_s;
    qsort(group->order, n, sizeof *group->order, by_phase);
  }
}

static ReplyKind reply_kind(const char *name) {
  static const char *const names[] = {"none", "json", "zlib", "msgpack", "peer"};
  for (int i = 0; i < 5; i++)
    if (!strcmp(name, names[i])) return (ReplyKind)i;
  fail("--reply is none, json, zlib, msgpack or peer, not %s", name);
  return REPLY_NONE;
}

static void read_options(int argc, char **argv) {
  const char *address = "127.0.0.1", *hello_file = NULL, *group_texts[MAX_GROUPS + 1];
  int port = 0, texts = 0, hello_count;
  option.path = "/ws";
  option.sources = option.first_source = 1;
  option.at_once = 64;
  option.seconds = 5;
  option.warm_up_s = 0.5;
  option.drain_s = 4;
  option.opening_s = 60;
  option.seed = 1;
  for (int i = 1; i < argc; i += 2) {
    const char *name = argv[i], *value = i + 1 < argc ? argv[i + 1] : NULL;
    if (!value || strncmp(name, "--", 2)) {
      fputs(USAGE, stderr);
      exit(2);
    }
    if (!strcmp(name, "--port")) port = atoi(value);
    else if (!strcmp(name, "--address")) address = value;
    else if (!strcmp(name, "--path")) option.path = value;
    else if (!strcmp(name, "--subprotocol")) option.subprotocol = value;
    else if (!strcmp(name, "--tokens")) read_tokens(value);
    else if (!strcmp(name, "--hello")) hello_file = value;
    else if (!strcmp(name, "--sources")) option.sources = atoi(value);
    else if (!strcmp(name, "--first-source")) option.first_source = atoi(value);
    else if (!strcmp(name, "--reply")) option.reply = reply_kind(value);
    else if (!strcmp(name, "--seconds")) option.seconds = atof(value);
    else if (!strcmp(name, "--warm-up")) option.warm_up_s = atof(value);
    else if (!strcmp(name, "--drain")) option.drain_s = atof(value);
    else if (!strcmp(name, "--opening")) option.opening_s = atof(value);
    else if (!strcmp(name, "--at-once")) option.at_once = atoi(value);
    else if (!strcmp(name, "--join-every")) option.join_every_s = atof(value);
    else if (!strcmp(name, "--obey")) option.obeys = atoi(value) != 0;
    else if (!strcmp(name, "--seed")) option.seed = (unsigned)strtoul(value, NULL, 10);
    else if (!strcmp(name, "--samples")) {
      if (!(option.samples = fopen(value, "wb"))) fail("cannot write %s", value);
    } else if (!strcmp(name, "--group") && texts < MAX_GROUPS) group_texts[texts++] = value;
    else fail("unknown option %s", name);
  }
  option.address.sin_family = AF_INET;
  option.address.sin_port = htons((uint16_t)port);
  if (inet_pton(AF_INET, address, &option.address.sin_addr) != 1 ||
      ntohl(option.address.sin_addr.s_addr) >> 24 != 127)
    fail("%s is not a loopback address; this program loads no other", address);
  if (port < 1 || port > 65535 || !texts) fail("--port and --group are required");
  if (option.sources < 1 || option.first_source < 1 || option.sources + option.first_source > 65000)
    fail("--sources and --first-source count from 1");
  if (option.at_once < 1) fail("--at-once counts from 1");
  for (int i = 0; i < texts; i++) read_group(group_texts[i]);
  if (!robot_count) fail("no robots");
  if (hello_file) hello = read_frames(hello_file, option.reply == REPLY_JSON ? 1 : 2, &hello_count);
}

static void ask_to_stop(int number) {
  (void)number;
  stop_asked = 1;
}

int main(int argc, char **argv) {
  if (argc == 2 && !strcmp(argv[1], "--help")) {
    fputs(USAGE, stdout);
    return 0;
  }
  read_options(argc, argv);
  struct rlimit files;
  getrlimit(RLIMIT_NOFILE, &files);
  files.rlim_cur = files.rlim_max;
  setrlimit(RLIMIT_NOFILE, &files);
  if ((rlim_t)robot_count + 32 > files.rlim_max)
    fail("%d robots, but %d open files", robot_count, (int)files.rlim_max);
  prctl(PR_SET_PDEATHSIG, SIGKILL);
  prctl(PR_SET_TIMERSLACK, 1000UL);
  signal(SIGTERM, ask_to_stop);
  signal(SIGINT, ask_to_stop);
  if (inflateInit(&inflater) != Z_OK) fail("zlib does not start");
  poller = epoll_create1(EPOLL_CLOEXEC);
  begin_s = now_s();
  prepare_groups();

  double opened_s = 0, cpu_begin_s = 0, cpu_s = 0;
  bool has_begun = false, has_ended = false, is_late = false;
  for (;;) {
    double now = now_s();
    open_waiting(now);
    bool is_open = settled == robot_count;
    if (first_s == INFINITY && (is_open || now > begin_s + option.opening_s)) {
      is_late = !is_open;
      opened_s = now - begin_s;
      begin_loops(now);
    }
    if (!has_begun && now >= first_s) {
      has_begun = true;
      cpu_begin_s = own_cpu_s();
      fprintf(stderr, "begin %.6f\n", first_s);
    }
    if (stop_asked && now < last_s) {
      first_s = fmin(first_s, now);
      last_s = now;
    }
    send_due(now); /* before the end is checked, so that every message planned in the window is sent */
    if (!has_ended && now >= last_s) {
      has_ended = true;
      cpu_s = own_cpu_s() - cpu_begin_s;
      fprintf(stderr, "end %.6f\n", last_s);
    }
    if (now >= last_s && (is_answered() || now >= last_s + option.drain_s)) break;
    take_events(now >= last_s ? now + 0.005 : next_event_s(now));
  }
  for (int i = 0; i < robot_count; i++) lose_unanswered(&robots[i]);
  print_report(opened_s, cpu_s, is_late);
  if (option.samples) fclose(option.samples);
  return 0;
}
