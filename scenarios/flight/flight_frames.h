/*
 * flight_frames.h: the C side of protocol `frames`, for flight software on a computer or a bare microcontroller.
 *
 * C99 and C++, this file alone, no library, no allocation; little-endian machines with IEEE 754 doubles.
 * Written from the vehicle's own table of structs: do not edit.
 *
 *     static flight_parser parser;                      one per line
 *     static flight_sender sender;                      takes a function that writes bytes
 *
 *     flight_start(&parser, &sender, write_bytes, NULL);
 *     flight_say_hello(&sender, clock_us());            setup comes again, and counts begin anew
 *     for each byte that comes:
 *         if (flight_put(&parser, byte))                a whole, valid frame
 *             switch (parser.frame.header.type) {
 *             case FLIGHT_READING: ... FLIGHT_STRUCT(&parser, flight_reading), flight_values(&parser, &count)
 *             case FLIGHT_TICK:    flight_answers(&sender, &parser); flight_command_dipole(&sender, ...);
 *                                  flight_say_done(&sender, clock_us());
 *             }
 *
 * Every tick comes as frames of readings, messages, results and refusals, then one of type FLIGHT_TICK, which is to be
 * answered: commands and words of the tick, then FLIGHT_DONE. Damaged, overlong and lost frames are counted.
 */
#ifndef FLIGHT_FRAMES_H
#define FLIGHT_FRAMES_H

#include <stddef.h>
#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

#define FLIGHT_VERSION 1

/* Of a frame, unstuffed, in both directions: enough for all but long messages. Overlong ones are counted and skipped. */
#ifndef FLIGHT_FRAME_BYTES_MAX
#define FLIGHT_FRAME_BYTES_MAX 256
#endif
#define FLIGHT_CRC_BYTES 4
#define FLIGHT_STUFFED_BYTES_MAX (FLIGHT_FRAME_BYTES_MAX + FLIGHT_FRAME_BYTES_MAX / 254 + 2)

#if defined(__BYTE_ORDER__) && __BYTE_ORDER__ != __ORDER_LITTLE_ENDIAN__
#error "flight_frames.h: expected a little-endian machine"
#endif

/* Fails to compile where a struct is not laid out as it travels. */
#define FLIGHT_HOLDS(name, claim) typedef char flight_holds_##name[(claim) ? 1 : -1]

typedef struct {
    uint8_t type;
    uint8_t version;
    uint16_t sequence;
    uint16_t size; /* Bytes of struct and what follows it. */
    uint16_t reserved;
    double t_s; /* Simulated time of the tick. */
} flight_header;
FLIGHT_HOLDS(header, sizeof(flight_header) == 16);

enum flight_type {
    FLIGHT_SETUP = 1,
    FLIGHT_SETTING = 2,
    FLIGHT_READING = 3,
    FLIGHT_MESSAGE = 4,
    FLIGHT_RESULT = 5,
    FLIGHT_REFUSAL = 6,
    FLIGHT_TICK = 7,
    FLIGHT_HELLO = 128,
    FLIGHT_DELTA_V = 129,
    FLIGHT_TORQUE = 130,
    FLIGHT_BALLISTIC = 131,
    FLIGHT_DIPOLE = 132,
    FLIGHT_SEND = 133,
    FLIGHT_ESTIMATE = 134,
    FLIGHT_LOG = 135,
    FLIGHT_DONE = 136
};
enum flight_input {
    FLIGHT_INPUT_MEASUREMENTS = 0,
    FLIGHT_INPUT_TRUTH = 1
};
enum flight_clock {
    FLIGHT_CLOCK_STEPPED = 0,
    FLIGHT_CLOCK_OWN = 1
};
enum flight_frame {
    FLIGHT_FRAME_INERTIAL = 0,
    FLIGHT_FRAME_RTN = 1,
    FLIGHT_FRAME_BODY = 2
};
enum flight_status {
    FLIGHT_STATUS_ACCEPTED = 0,
    FLIGHT_STATUS_EXECUTED = 1,
    FLIGHT_STATUS_POSTPONED = 2,
    FLIGHT_STATUS_REFUSED = 3
};
enum flight_level {
    FLIGHT_LEVEL_CRITICAL = 0,
    FLIGHT_LEVEL_ERROR = 1,
    FLIGHT_LEVEL_WARNING = 2,
    FLIGHT_LEVEL_INFO = 3,
    FLIGHT_LEVEL_DEBUG = 4
};
enum flight_encoding {
    FLIGHT_ENCODING_BYTES = 0,
    FLIGHT_ENCODING_JSON = 1
};
enum flight_sensor {
    FLIGHT_SENSOR_TRUTH = 0,
    FLIGHT_SENSOR_GNSS = 1,
    FLIGHT_SENSOR_GYRO = 2,
    FLIGHT_SENSOR_ACCELEROMETER = 3,
    FLIGHT_SENSOR_MAGNETOMETER = 4,
    FLIGHT_SENSOR_STAR_TRACKER = 5,
    FLIGHT_SENSOR_SUN_SENSOR = 6,
    FLIGHT_SENSOR_CLOCK = 7,
    FLIGHT_SENSOR_MASS = 8,
    FLIGHT_SENSOR_WHEELS = 9
};

/* Who the vehicle is: first of all, and again after each hello. */
typedef struct {
    double tick_hz; /* Rate of the agent's ticks, Hz. */
    double duration_s; /* Of the run, s. */
    uint32_t first_number; /* Of its first command. */
    uint32_t seed; /* For its chance. */
    uint16_t index; /* Place among the agents, from 0. */
    uint16_t agents; /* Count of agents in the run. */
    uint16_t settings; /* Count of frames of settings that follow. */
    uint8_t input; /* enum flight_input */
    uint8_t clock; /* enum flight_clock */
    char name[32]; /* The agent's. */
    char satellite[32];
    char epoch_utc[32]; /* UTC of simulated time zero, ISO 8601. */
} flight_setup;
FLIGHT_HOLDS(setup, sizeof(flight_setup) == 128);

/* One value of the scenario's settings. */
typedef struct {
    double value; /* A number; a truth value is 0 or 1. */
    uint16_t index; /* Place in a list, from 0. */
    uint16_t count; /* Values in the list; 0 for a value by itself. */
    uint8_t is_text; /* Whether text holds it, not value. */
    uint8_t reserved[3];
    char name[32];
    char text[48];
} flight_setting;
FLIGHT_HOLDS(setting, sizeof(flight_setting) == 96);

/* One measurement; count doubles follow, in the units of the sensor. [count doubles follow] */
typedef struct {
    double valid_s; /* Simulated time at which it was valid, s. */
    uint8_t sensor; /* enum flight_sensor */
    uint8_t count; /* Values that follow, at most 13. */
    uint8_t reserved[6];
} flight_reading;
FLIGHT_HOLDS(reading, sizeof(flight_reading) == 16);

/* A message by radio; size bytes of payload follow. [size bytes follow] */
typedef struct {
    double sent_s; /* Simulated time, s. */
    double arrives_s; /* Simulated time, s. */
    uint16_t size; /* Bytes of the payload. */
    uint8_t encoding; /* Of the payload; json for all that is not bytes. */
    uint8_t reserved[5];
    char sender[32];
} flight_message;
FLIGHT_HOLDS(message, sizeof(flight_message) == 56);

/* What became of a command. */
typedef struct {
    double at_s; /* Simulated time at which it is, or would have been, executed, s. */
    double delta_v_m_s; /* Magnitude really given, m/s. */
    double propellant_kg; /* Left after the command, kg. */
    uint32_t number; /* Of the command: they count from first_number on. */
    uint32_t revision; /* Of the truth that holds it. */
    uint8_t status; /* enum flight_status */
    uint8_t reserved[7];
    char reason[64];
} flight_result;
FLIGHT_HOLDS(result, sizeof(flight_result) == 104);

/* A message of its own that was refused. */
typedef struct {
    double sent_s; /* Simulated time, s. */
    uint32_t number; /* Of the message: they count from 0 on. */
    uint8_t reserved[4];
    char to[32];
    char reason[32];
} flight_refusal;
FLIGHT_HOLDS(refusal, sizeof(flight_refusal) == 80);

/* End of a tick's report, to be answered by done; so many of each kind came before it. */
typedef struct {
    uint16_t readings;
    uint16_t messages;
    uint16_t results;
    uint16_t refusals;
} flight_tick;
FLIGHT_HOLDS(tick, sizeof(flight_tick) == 8);

/* From software that has started: counts begin anew, and setup is sent again. */
typedef struct {
    uint64_t board_us; /* The board's own clock, us; 0 for none. */
} flight_hello;
FLIGHT_HOLDS(hello, sizeof(flight_hello) == 8);

/* Command of a change of velocity. */
typedef struct {
    double delta_v_m_s[3];
    double at_s; /* Simulated time of execution, s. */
    uint8_t frame; /* enum flight_frame */
    uint8_t reserved[7];
} flight_delta_v;
FLIGHT_HOLDS(delta_v, sizeof(flight_delta_v) == 40);

/* Command of a torque about the body axes. */
typedef struct {
    double torque_n_m[3];
    double at_s; /* Simulated time of its beginning, s. */
    double duration_s;
} flight_torque;
FLIGHT_HOLDS(torque, sizeof(flight_torque) == 40);

/* Command of another ballistic coefficient. */
typedef struct {
    double ballistic_m2_kg;
    double at_s; /* Simulated time of execution, s. */
} flight_ballistic;
FLIGHT_HOLDS(ballistic, sizeof(flight_ballistic) == 16);

/* Command of a magnetic dipole of the magnetorquers, in body axes. */
typedef struct {
    double dipole_a_m2[3];
    double at_s; /* Simulated time of its beginning, s. */
    double duration_s;
} flight_dipole;
FLIGHT_HOLDS(dipole, sizeof(flight_dipole) == 40);

/* A message by radio; size bytes of payload follow. [size bytes follow] */
typedef struct {
    uint16_t size; /* Bytes of the payload. */
    uint8_t encoding; /* Of the payload. */
    uint8_t reserved[5];
    char to[32]; /* Agent, satellite, ground, ground:NAME, or * for all in view. */
} flight_send;
FLIGHT_HOLDS(send, sizeof(flight_send) == 40);

/* One value that is believed; not a number for nothing. */
typedef struct {
    double value;
    char name[32]; /* Ends in its unit, as a_m. */
} flight_estimate;
FLIGHT_HOLDS(estimate, sizeof(flight_estimate) == 40);

/* A sentence for the log; size bytes of text follow. [size bytes follow] */
typedef struct {
    uint16_t size; /* Bytes of the text. */
    uint8_t level; /* enum flight_level */
    uint8_t reserved[5];
} flight_log;
FLIGHT_HOLDS(log, sizeof(flight_log) == 8);

/* The answer to the tick of its time is whole: what came since the last done belongs to it. */
typedef struct {
    uint64_t board_us; /* The board's own clock, us; 0 for none. */
} flight_done;
FLIGHT_HOLDS(done, sizeof(flight_done) == 8);

FLIGHT_HOLDS(frame_bytes, FLIGHT_FRAME_BYTES_MAX >= 16 + 128 + FLIGHT_CRC_BYTES);

typedef struct {
    union {
        flight_header header;
        uint8_t bytes[FLIGHT_FRAME_BYTES_MAX];
    } frame; /* Valid until the next byte is put. */
    uint32_t length;
    uint8_t code; /* Of the COBS block under way. */
    uint8_t left; /* Bytes of it to come. */
    uint8_t is_skipping;
    uint8_t has_sequence;
    uint16_t next_sequence;
    /* Counts, for whoever wants them. */
    uint32_t frames;
    uint32_t damaged;
    uint32_t overlong;
    uint32_t lost;
} flight_parser;

typedef void (*flight_write)(void *where, const uint8_t *bytes, size_t count);

typedef struct {
    flight_write write;
    void *where; /* Handed to write. */
    double t_s;  /* Time of the tick that is answered. */
    uint16_t sequence;
    uint8_t stuffed[FLIGHT_STUFFED_BYTES_MAX];
} flight_sender;

/* Copied byte by byte through a volatile, lest a compiler makes a call of memcpy of it. */
static inline void flight_copy(void *to, const void *from, size_t count)
{
    volatile uint8_t *target = (volatile uint8_t *)to;
    const uint8_t *source = (const uint8_t *)from;
    size_t i;
    for (i = 0; i < count; i++)
        target[i] = source[i];
}

/* CRC-32 of Ethernet, 0xEDB88320 reflected; begin with 0 and go on with what it returned. */
static inline uint32_t flight_crc32(uint32_t crc, const void *data, size_t count)
{
    static const uint32_t table[16] = {
        0x00000000u, 0x1db71064u, 0x3b6e20c8u, 0x26d930acu, 0x76dc4190u, 0x6b6b51f4u,
        0x4db26158u, 0x5005713cu, 0xedb88320u, 0xf00f9344u, 0xd6d6a3e8u, 0xcb61b38cu,
        0x9b64c2b0u, 0x86d3d2d4u, 0xa00ae278u, 0xbdbdf21cu};
    const uint8_t *bytes = (const uint8_t *)data;
    crc = ~crc;
    while (count--) {
        crc ^= *bytes++;
        crc = (crc >> 4) ^ table[crc & 15u];
        crc = (crc >> 4) ^ table[crc & 15u];
    }
    return ~crc;
}

/* Stuff data without zeros into out, which has room for count + count / 254 + 1 bytes; returns how many it wrote. */
static inline size_t flight_cobs_encode(const uint8_t *data, size_t count, uint8_t *out)
{
    size_t place = 1, start = 0, i;
    uint8_t code = 1;
    for (i = 0; i < count; i++) {
        if (data[i] != 0) {
            out[place++] = data[i];
            if (++code != 0xFF)
                continue;
        }
        out[start] = code;
        code = 1;
        if (data[i] == 0 || i + 1 < count)
            start = place++;
        else
            return place;
    }
    out[start] = code;
    return place;
}

/* Undo that; returns how many bytes, at most count, or SIZE_MAX for what cannot be. In place is allowed. */
static inline size_t flight_cobs_decode(const uint8_t *data, size_t count, uint8_t *out)
{
    size_t from = 0, to = 0;
    while (from < count) {
        uint8_t code = data[from++], i;
        if (code == 0 || (size_t)(code - 1) > count - from)
            return (size_t)-1;
        for (i = 1; i < code; i++) {
            if (data[from] == 0)
                return (size_t)-1;
            out[to++] = data[from++];
        }
        if (code < 0xFF && from < count)
            out[to++] = 0;
    }
    return to;
}

static inline void flight_start(flight_parser *parser, flight_sender *sender, flight_write write, void *where)
{
    parser->length = parser->frames = parser->damaged = parser->overlong = parser->lost = 0;
    parser->code = 0xFF;
    parser->left = parser->is_skipping = parser->has_sequence = 0;
    parser->next_sequence = 0;
    sender->write = write;
    sender->where = where;
    sender->t_s = 0.0;
    sender->sequence = 0;
}

static inline int flight_check(flight_parser *parser)
{
    const flight_header *header = &parser->frame.header;
    uint32_t crc, length = parser->length;
    if (parser->left != 0 || length < sizeof(flight_header) + FLIGHT_CRC_BYTES)
        return 0;
    length -= FLIGHT_CRC_BYTES;
    flight_copy(&crc, parser->frame.bytes + length, sizeof crc);
    return flight_crc32(0, parser->frame.bytes, length) == crc && header->version == FLIGHT_VERSION &&
           header->size == length - sizeof(flight_header);
}

/* Take a byte; returns 1 when it ends a whole, valid frame, which is then in parser->frame. */
static inline int flight_put(flight_parser *parser, uint8_t byte)
{
    int is_whole = 0;
    if (byte == 0) { /* the end of a frame, whatever came before */
        if (parser->is_skipping) {
            parser->overlong++;
        } else if (parser->length != 0 || parser->left != 0) {
            is_whole = flight_check(parser);
            parser->damaged += !is_whole;
        }
        if (is_whole) {
            uint16_t sequence = parser->frame.header.sequence;
            uint16_t ahead = (uint16_t)(sequence - parser->next_sequence);
            parser->frames++;
            /* What lies behind came twice, or out of order: nothing is missing. */
            if (parser->has_sequence && parser->frame.header.type != FLIGHT_SETUP && ahead < 0x8000u)
                parser->lost += ahead;
            parser->has_sequence = 1;
            parser->next_sequence = (uint16_t)(sequence + 1u);
        }
        parser->length = 0;
        parser->code = 0xFF;
        parser->left = parser->is_skipping = 0;
        return is_whole;
    }
    if (parser->is_skipping)
        return 0;
    if (parser->left == 0) { /* the first byte of a block; a block that was not full stands for a zero */
        uint8_t had_zero = parser->code != 0xFF;
        parser->code = byte;
        parser->left = (uint8_t)(byte - 1u);
        if (!had_zero)
            return 0;
        byte = 0;
    } else {
        parser->left--;
    }
    if (parser->length >= FLIGHT_FRAME_BYTES_MAX) {
        parser->is_skipping = 1;
        return 0;
    }
    parser->frame.bytes[parser->length++] = byte;
    return 0;
}

/* The struct of the frame that flight_put found, for a cast to its type; NULL if it is shorter than size. */
static inline const void *flight_struct_of(const flight_parser *parser, size_t size)
{
    return parser->frame.header.size >= size ? parser->frame.bytes + sizeof(flight_header) : NULL;
}
#define FLIGHT_STRUCT(parser, type) ((const type *)flight_struct_of((parser), sizeof(type)))

/* The values of a reading, and how many there are. */
static inline const double *flight_values(const flight_parser *parser, size_t *count)
{
    size_t size = parser->frame.header.size;
    *count = size >= sizeof(flight_reading) ? (size - sizeof(flight_reading)) / sizeof(double) : 0;
    return (const double *)(const void *)(parser->frame.bytes + sizeof(flight_header) + sizeof(flight_reading));
}

/* Send a frame: a struct, and what follows it; returns 0 if it is too long. */
static inline int flight_send_frame(flight_sender *sender, uint8_t type, const void *data, size_t size,
                                    const void *tail, size_t tail_size)
{
    union {
        flight_header header;
        uint8_t bytes[FLIGHT_FRAME_BYTES_MAX];
    } frame;
    size_t length = sizeof(flight_header) + size + tail_size;
    uint32_t crc;
    if (tail_size > FLIGHT_FRAME_BYTES_MAX || length + FLIGHT_CRC_BYTES > FLIGHT_FRAME_BYTES_MAX)
        return 0;
    frame.header.type = type;
    frame.header.version = FLIGHT_VERSION;
    frame.header.sequence = sender->sequence++;
    frame.header.size = (uint16_t)(size + tail_size);
    frame.header.reserved = 0;
    frame.header.t_s = sender->t_s;
    flight_copy(frame.bytes + sizeof(flight_header), data, size);
    flight_copy(frame.bytes + sizeof(flight_header) + size, tail, tail_size);
    crc = flight_crc32(0, frame.bytes, length);
    flight_copy(frame.bytes + length, &crc, FLIGHT_CRC_BYTES);
    length = flight_cobs_encode(frame.bytes, length + FLIGHT_CRC_BYTES, sender->stuffed);
    sender->stuffed[length++] = 0;
    sender->write(sender->where, sender->stuffed, length);
    return 1;
}

/* What is sent from now on answers the tick whose frame of type FLIGHT_TICK was just found. */
static inline void flight_answers(flight_sender *sender, const flight_parser *parser)
{
    sender->t_s = parser->frame.header.t_s;
}

static inline int flight_say_hello(flight_sender *sender, uint64_t board_us)
{
    flight_hello hello;
    hello.board_us = board_us;
    sender->sequence = 0;
    return flight_send_frame(sender, FLIGHT_HELLO, &hello, sizeof hello, NULL, 0);
}

static inline int flight_say_done(flight_sender *sender, uint64_t board_us)
{
    flight_done done;
    done.board_us = board_us;
    return flight_send_frame(sender, FLIGHT_DONE, &done, sizeof done, NULL, 0);
}

static inline int flight_command_delta_v(flight_sender *sender, const double delta_v_m_s[3], double at_s, uint8_t frame)
{
    flight_delta_v command = {{0.0, 0.0, 0.0}, 0.0, 0, {0}};
    flight_copy(command.delta_v_m_s, delta_v_m_s, sizeof command.delta_v_m_s);
    command.at_s = at_s;
    command.frame = frame;
    return flight_send_frame(sender, FLIGHT_DELTA_V, &command, sizeof command, NULL, 0);
}

static inline int flight_command_torque(flight_sender *sender, const double torque_n_m[3], double at_s, double duration_s)
{
    flight_torque command;
    flight_copy(command.torque_n_m, torque_n_m, sizeof command.torque_n_m);
    command.at_s = at_s;
    command.duration_s = duration_s;
    return flight_send_frame(sender, FLIGHT_TORQUE, &command, sizeof command, NULL, 0);
}

static inline int flight_command_dipole(flight_sender *sender, const double dipole_a_m2[3], double at_s, double duration_s)
{
    flight_dipole command;
    flight_copy(command.dipole_a_m2, dipole_a_m2, sizeof command.dipole_a_m2);
    command.at_s = at_s;
    command.duration_s = duration_s;
    return flight_send_frame(sender, FLIGHT_DIPOLE, &command, sizeof command, NULL, 0);
}

static inline int flight_command_ballistic(flight_sender *sender, double ballistic_m2_kg, double at_s)
{
    flight_ballistic command;
    command.ballistic_m2_kg = ballistic_m2_kg;
    command.at_s = at_s;
    return flight_send_frame(sender, FLIGHT_BALLISTIC, &command, sizeof command, NULL, 0);
}

/* Text without its end into a field of a struct, filled up with zeros. */
static inline void flight_set_text(char *field, size_t room, const char *text)
{
    size_t i;
    for (i = 0; i < room && text[i]; i++)
        field[i] = text[i];
    for (; i < room; i++)
        ((volatile char *)field)[i] = 0;
}

static inline int flight_say_estimate(flight_sender *sender, const char *name, double value)
{
    flight_estimate estimate;
    estimate.value = value;
    flight_set_text(estimate.name, sizeof estimate.name, name);
    return flight_send_frame(sender, FLIGHT_ESTIMATE, &estimate, sizeof estimate, NULL, 0);
}

static inline int flight_say_log(flight_sender *sender, uint8_t level, const char *text)
{
    flight_log log = {0, 0, {0}};
    while (text[log.size])
        log.size++;
    log.level = level;
    return flight_send_frame(sender, FLIGHT_LOG, &log, sizeof log, text, log.size);
}

static inline int flight_radio(flight_sender *sender, const char *to, const void *payload, uint16_t size)
{
    flight_send send = {0, 0, {0}, {0}};
    send.size = size;
    send.encoding = FLIGHT_ENCODING_BYTES;
    flight_set_text(send.to, sizeof send.to, to);
    return flight_send_frame(sender, FLIGHT_SEND, &send, sizeof send, payload, size);
}

#ifdef __cplusplus
}
#endif
#endif
