// Messages of /v1/stream, protocol 3: binary ones are little endian, text ones are JSON. C++17, no types of Unreal, no exceptions.
#pragma once

#include <array>
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <cstring>
#include <optional>
#include <string>
#include <string_view>
#include <vector>

#include "Pose.h"

namespace nafir {

inline constexpr int kProtocol = 3;

enum class Encoding : std::uint8_t { kFloat32 = 0, kInt16 = 1 };

inline const char* NameOf(Encoding encoding) { return encoding == Encoding::kFloat32 ? "f32" : "s16"; }

// A block of rendered audio. `samples` are interleaved: left, right, or the channels of ambisonics.
struct AudioBlock {
  std::uint32_t sequence = 0;
  std::uint64_t sample_clock = 0;
  std::uint32_t pose_id = 0;
  std::uint32_t reverberation_pose_id = 0;
  std::uint8_t flags = 0;
  std::uint16_t channels = 0;
  std::uint8_t listener = 0;  // the number of who hears it: 0 for the first
  std::vector<float> samples;
};

// What an emitter plays, and how. Without a clip it plays the samples that the client sends. Clocks are those of the stream.
struct Source {
  std::string clip;
  Pose pose;
  double gain_db = 0;
  bool loop = true;
  std::optional<std::uint64_t> start_at, stop_at;             // begins, and fades out; else at once, and never
  double offset_s = 0, loop_start_s = 0, loop_end_s = 0;      // where the clip begins, and what repeats; an end of 0 is the clip's
  bool remove_when_ended = false;                             // once the clip and its reverberation are over
  double jitter_ms = 0;                                       // how long live samples wait at the server; 0 for its own choice
};

namespace wire {

inline constexpr std::uint8_t kAudioBlock = 1, kListener = 2, kDryBlock = 3;
inline constexpr std::size_t kAudioHeaderBytes = 28, kListenerBytes = 36;
inline constexpr float kFullScale = 32767;

template <typename Number>
Number Read(const std::uint8_t* data) {
  // By shifts, so that the order of bytes is the protocol's on every processor.
  std::uint64_t bits = 0;
  for (std::size_t i = 0; i < sizeof(Number); ++i) bits |= std::uint64_t{data[i]} << (8 * i);
  return static_cast<Number>(bits);
}

inline float ReadFloat(const std::uint8_t* data) {
  const auto bits = Read<std::uint32_t>(data);
  float value;
  std::memcpy(&value, &bits, sizeof value);
  return value;
}

template <typename Number>
void Write(std::uint8_t* data, Number value) {
  for (std::size_t i = 0; i < sizeof(Number); ++i) data[i] = static_cast<std::uint8_t>(std::uint64_t{value} >> (8 * i));
}

inline void WriteFloat(std::uint8_t* data, float value) {
  std::uint32_t bits;
  std::memcpy(&bits, &value, sizeof bits);
  Write(data, bits);
}

inline std::size_t BytesPerSample(Encoding encoding) { return encoding == Encoding::kFloat32 ? 4 : 2; }

inline std::string Quoted(std::string_view text) {
  std::string quoted = "\"";
  for (const char each : text) {
    if (each == '"' || each == '\\') {
      quoted += '\\';
      quoted += each;
    } else if (static_cast<unsigned char>(each) < 0x20) {
      char escaped[8];
      std::snprintf(escaped, sizeof escaped, "\\u%04x", each);
      quoted += escaped;
    } else {
      quoted += each;
    }
  }
  return quoted + '"';
}

// Enough digits for a float, and a point whatever the locale.
inline std::string Number(double value) {
  char text[32];
  std::snprintf(text, sizeof text, "%.9g", value);
  std::string number = text;
  for (char& each : number) {
    if (each == ',') each = '.';
  }
  return number;
}

// A clock of the stream as the server counts.
inline std::string Clock(std::uint64_t clock, std::uint64_t offset) { return std::to_string(clock > offset ? clock - offset : 0); }

inline std::string Numbers(const Pose& pose) {
  const auto& [p, q] = pose;
  return "\"position\":[" + Number(p.x) + "," + Number(p.y) + "," + Number(p.z) + "],\"orientation\":[" + Number(q.x) + "," + Number(q.y) +
         "," + Number(q.z) + "," + Number(q.w) + "]";
}

}  // namespace wire

// The block that a binary message holds; none if it holds another kind, which a client ignores, or is damaged.
inline std::optional<AudioBlock> ParseAudioBlock(const std::uint8_t* data, std::size_t size, Encoding encoding) {
  if (size < wire::kAudioHeaderBytes || data[0] != wire::kAudioBlock) return std::nullopt;
  AudioBlock block;
  block.flags = data[1];
  block.channels = data[2];
  block.listener = data[3];
  block.sequence = wire::Read<std::uint32_t>(data + 4);
  block.sample_clock = wire::Read<std::uint64_t>(data + 8);
  block.pose_id = wire::Read<std::uint32_t>(data + 16);
  block.reverberation_pose_id = wire::Read<std::uint32_t>(data + 20);
  const std::uint64_t frames = wire::Read<std::uint32_t>(data + 24);
  const std::size_t each = wire::BytesPerSample(encoding);
  if (block.channels == 0 || size - wire::kAudioHeaderBytes != frames * block.channels * each) return std::nullopt;
  block.samples.resize(frames * block.channels);
  for (std::size_t i = 0; i < block.samples.size(); ++i) {
    const std::uint8_t* at = data + wire::kAudioHeaderBytes + each * i;
    block.samples[i] = encoding == Encoding::kFloat32 ? wire::ReadFloat(at) : static_cast<std::int16_t>(wire::Read<std::uint16_t>(at)) / wire::kFullScale;
  }
  return block;
}

// A listener's pose. `pose_id` rises over all poses of the stream, of listeners and emitters. `number` is that of a listener beside the
// first.
inline std::array<std::uint8_t, wire::kListenerBytes> SerializeListener(std::uint32_t pose_id, const Pose& pose, std::uint8_t number = 0) {
  std::array<std::uint8_t, wire::kListenerBytes> data{};
  data[0] = wire::kListener;
  data[1] = number;
  wire::Write(data.data() + 4, pose_id);
  const auto& [p, q] = pose;
  const double numbers[] = {p.x, p.y, p.z, q.x, q.y, q.z, q.w};
  for (std::size_t i = 0; i < 7; ++i) wire::WriteFloat(data.data() + 8 + 4 * i, static_cast<float>(numbers[i]));
  return data;
}

// The next mono samples of a live emitter. `sequence` rises from block to block; an id has at most 64 characters.
inline std::vector<std::uint8_t> SerializeDryBlock(std::string_view id, std::uint32_t sequence, const float* samples, std::size_t frames, Encoding encoding) {
  const std::size_t padded = (id.size() + 3) / 4 * 4;
  const std::size_t each = wire::BytesPerSample(encoding);
  std::vector<std::uint8_t> data(12 + padded + each * frames);
  data[0] = wire::kDryBlock;
  data[1] = static_cast<std::uint8_t>(encoding);
  wire::Write(data.data() + 2, static_cast<std::uint16_t>(id.size()));
  wire::Write(data.data() + 4, sequence);
  wire::Write(data.data() + 8, static_cast<std::uint32_t>(frames));
  std::memcpy(data.data() + 12, id.data(), id.size());
  for (std::size_t i = 0; i < frames; ++i) {
    std::uint8_t* at = data.data() + 12 + padded + each * i;
    if (encoding == Encoding::kFloat32) {
      wire::WriteFloat(at, samples[i]);
    } else {
      const float clipped = samples[i] < -1 ? -1 : samples[i] > 1 ? 1 : samples[i];
      wire::Write(at, static_cast<std::uint16_t>(static_cast<std::int16_t>(std::lround(clipped * wire::kFullScale))));
    }
  }
  return data;
}

namespace message {

// The first message. A `sample_rate` of 0 takes the scene's own; without a `level` the server chooses. With `snapshots` a server that has a
// secret sends the stream's state now and then. `listeners` is how many the stream is about to have.
inline std::string Hello(std::string_view scene, int sample_rate, int block_size, Encoding encoding, int buffer_blocks, const Pose& listener,
                         std::string_view level = {}, bool snapshots = false, std::size_t listeners = 1) {
  std::string text = "{\"type\":\"hello\",\"protocol\":" + std::to_string(kProtocol) + ",\"scene\":" + wire::Quoted(scene) +
                     ",\"block_size\":" + std::to_string(block_size) + ",\"encoding\":\"" + NameOf(encoding) +
                     "\",\"buffer_blocks\":" + std::to_string(buffer_blocks) + ",\"listener\":{" + wire::Numbers(listener) + "}";
  if (sample_rate > 0) text += ",\"sample_rate\":" + std::to_string(sample_rate);
  if (!level.empty()) text += ",\"level\":" + wire::Quoted(level);
  if (snapshots) text += ",\"snapshots\":true";
  if (listeners > 1) text += ",\"listeners\":" + std::to_string(listeners);
  return text + "}";
}

// The first message of a connection that goes on with a lost stream: the token of the last welcome and the newest snapshot, of which one may
// be empty, and the last block that arrived, whoever's it is, if one has.
inline std::string Resume(std::string_view token, std::string_view snapshot, const AudioBlock* last) {
  std::string text = "{\"type\":\"resume\",\"protocol\":" + std::to_string(kProtocol);
  if (!token.empty()) text += ",\"token\":" + wire::Quoted(token);
  if (!snapshot.empty()) text += ",\"snapshot\":" + wire::Quoted(snapshot);
  if (last != nullptr) text += ",\"sequence\":" + std::to_string(last->sequence) + ",\"sample_clock\":" + std::to_string(last->sample_clock);
  return text + "}";
}

// The stream's clock is `clock_offset` samples ahead of the server's.
inline std::string AddEmitter(std::string_view id, const Source& source, std::uint64_t clock_offset = 0) {
  std::string text = "{\"type\":\"add_emitter\",\"id\":" + wire::Quoted(id) + "," + wire::Numbers(source.pose) +
                     ",\"gain_db\":" + wire::Number(source.gain_db);
  if (source.clip.empty()) {
    text += ",\"live\":true";
    if (source.jitter_ms > 0) text += ",\"jitter_ms\":" + wire::Number(source.jitter_ms);
    return text + "}";
  }
  text += ",\"clip\":" + wire::Quoted(source.clip) + ",\"loop\":" + (source.loop ? "true" : "false");
  if (source.start_at) text += ",\"start_at\":" + wire::Clock(*source.start_at, clock_offset);
  if (source.stop_at) text += ",\"stop_at\":" + wire::Clock(*source.stop_at, clock_offset);
  if (source.offset_s > 0) text += ",\"offset_s\":" + wire::Number(source.offset_s);
  if (source.loop && source.loop_start_s > 0) text += ",\"loop_start_s\":" + wire::Number(source.loop_start_s);
  if (source.loop && source.loop_end_s > 0) text += ",\"loop_end_s\":" + wire::Number(source.loop_end_s);
  if (source.remove_when_ended) text += ",\"remove_when_ended\":true";
  return text + "}";
}

// An emitter that plays a clip of the server.
inline std::string AddClip(std::string_view id, std::string_view clip, const Pose& pose, double gain_db = 0, bool loop = true) {
  Source source;
  source.clip = clip;
  source.pose = pose;
  source.gain_db = gain_db;
  source.loop = loop;
  return AddEmitter(id, source);
}

// An emitter that plays the dry blocks that the client sends for it.
inline std::string AddLive(std::string_view id, const Pose& pose, double gain_db = 0) { return AddClip(id, {}, pose, gain_db); }

// Lets a clip fade out from a clock on, or at once.
inline std::string StopEmitter(std::string_view id, double fade_s, std::optional<std::uint64_t> stop_at, std::uint64_t clock_offset = 0) {
  std::string text = "{\"type\":\"stop_emitter\",\"id\":" + wire::Quoted(id) + ",\"fade_s\":" + wire::Number(fade_s);
  if (stop_at) text += ",\"stop_at\":" + wire::Clock(*stop_at, clock_offset);
  return text + "}";
}

inline std::string SetLevel(std::string_view level) { return "{\"type\":\"set_level\",\"level\":" + wire::Quoted(level) + "}"; }

inline std::string Ping(std::uint32_t id) { return "{\"type\":\"ping\",\"id\":" + std::to_string(id) + "}"; }

inline std::string MoveEmitter(std::string_view id, std::uint32_t pose_id, const Pose& pose) {
  return "{\"type\":\"move_emitter\",\"id\":" + wire::Quoted(id) + ",\"pose_id\":" + std::to_string(pose_id) + "," + wire::Numbers(pose) + "}";
}

// The gain is reached over `ramp_s` seconds, linearly in decibels.
inline std::string SetGain(std::string_view id, double gain_db, double ramp_s = 0) {
  return "{\"type\":\"set_gain\",\"id\":" + wire::Quoted(id) + ",\"gain_db\":" + wire::Number(gain_db) + ",\"ramp_s\":" + wire::Number(ramp_s) + "}";
}

// Opens a door of the scene so far, from 0, shut, to 1.
inline std::string SetDoor(std::string_view door, double openness) {
  return "{\"type\":\"set_door\",\"door\":" + wire::Quoted(door) + ",\"openness\":" + wire::Number(openness) + "}";
}

inline std::string RemoveEmitter(std::string_view id) { return "{\"type\":\"remove_emitter\",\"id\":" + wire::Quoted(id) + "}"; }

// Adds a listener beside the first. An empty `head` is the server's default.
inline std::string AddListener(std::string_view id, const Pose& pose, std::string_view head = {}) {
  std::string text = "{\"type\":\"add_listener\",\"id\":" + wire::Quoted(id) + "," + wire::Numbers(pose);
  if (!head.empty()) text += ",\"hrtf\":" + wire::Quoted(head);
  return text + "}";
}

inline std::string RemoveListener(std::string_view id) { return "{\"type\":\"remove_listener\",\"id\":" + wire::Quoted(id) + "}"; }

// Every block up to `sequence` has arrived, of the listener with this id or of the first (none). Without it the server soon stops sending.
inline std::string Acknowledge(std::uint32_t sequence, std::string_view listener = {}) {
  std::string text = "{\"type\":\"acknowledge\",\"sequence\":" + std::to_string(sequence);
  if (!listener.empty()) text += ",\"listener\":" + wire::Quoted(listener);
  return text + "}";
}

}  // namespace message

}  // namespace nafir
