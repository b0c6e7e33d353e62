// A stream of /v1/stream, protocol 3, without its socket: messages in, messages out, and frames to play. It keeps what is wanted (poses,
// listeners, emitters, level). A server that has kept a lost stream goes on with it, and is sent what it had not got; else the stream begins anew.
// C++17, no types of Unreal, no exceptions. All but Read is for one thread.
#pragma once

#include <algorithm>
#include <cstdint>
#include <deque>
#include <functional>
#include <map>
#include <memory>
#include <optional>
#include <random>
#include <set>
#include <string>
#include <string_view>
#include <utility>
#include <vector>

#include "Ears.h"
#include "Json.h"
#include "Playback.h"
#include "Pose.h"
#include "Wire.h"

namespace nafir {

// kWaiting is a stream whose connection is lost and is going to be tried again. kRefused and kLost are final: the server does not want the
// stream, or could not be reached for too long.
enum class State { kConnecting, kLive, kWaiting, kRefused, kLost };

inline const char* NameOf(State state) {
  constexpr const char* kNames[] = {"Connecting", "Live", "Waiting", "Refused", "Lost"};
  return kNames[static_cast<int>(state)];
}

// Counts run over all connections and listeners of a stream; `underruns` and `waiting_s` are of the first listener. A block is skipped by the server, or lost with a connection.
struct Statistics {
  std::uint64_t blocks = 0, blocks_late = 0, blocks_skipped = 0;
  unsigned underruns = 0, reconnections = 0, resumptions = 0;
  double round_trip_s = 0, waiting_s = 0;
};

struct SessionOptions {
  std::string scene = "apartment";
  int sample_rate = 0;  // 44100, 48000 or 96000; 0 takes the scene's own
  int block_size = 256;
  int buffer_blocks = 8;
  double output_rate = 48000;    // of Read
  double target_s = 0.06;        // held back against a network that stalls
  double give_up_after_s = 300;  // for so long a server that is gone is tried again
  std::size_t listeners = 1;     // there are going to be so many, the first one included: the server keeps room for them
};

class Session {
 public:
  enum class Todo { kNothing, kConnect, kDrop };

  struct Outgoing {
    bool is_text;
    std::string data;
  };

  // What the game may want to know. Called within the calls below.
  std::function<void(State)> on_state;                                          // problem() says why
  std::function<void(const std::string& id)> on_emitter_added;                  // it is heard
  std::function<void(const std::string& id)> on_emitter_ended;                  // with its reverberation, or it cannot go on after a loss
  std::function<void(const std::string& id, const std::string& why)> on_emitter_refused;
  std::function<void(const std::string& id)> on_listener_added;  // one beside the first; also where the stream began anew
  std::function<void(const std::string& id, const std::string& why)> on_listener_refused;  // it is forgotten

  explicit Session(SessionOptions options) : options_(std::move(options)) {}

  State state() const { return state_; }
  const std::string& problem() const { return problem_; }  // why the stream was refused or last lost
  const std::string& level() const { return level_; }  // that the first listener hears
  int sample_rate() const { return sample_rate_; }  // 0 before the first welcome
  // The clock of the frame after the newest block, which goes on over lost connections.
  std::uint64_t sample_clock() const { return sample_clock_; }
  std::uint32_t heard_pose_id() const { return heard_pose_id_; }

  Statistics statistics() const {
    Statistics found = counts_;
    found.underruns = ears_.underruns();
    found.waiting_s = ears_.waiting_s();
    return found;
  }

  // ---- what the game wants

  void SetListener(const Pose& pose) {
    listener_ = pose;
    listener_moved_ = true;
  }

  // Adds a listener beside the first, who hears the same emitters: a player at a split screen, or a spectator. Returns the ears from which
  // an audio thread reads. `head` is one of the server's; empty for its default. One with this id is moved.
  std::shared_ptr<Ears> AddListener(const std::string& id, const Pose& pose, const std::string& head = {}) {
    const auto [found, is_new] = others_.try_emplace(id);
    Other& other = found->second;
    other.pose = pose;
    other.moved = true;
    if (is_new) {
      other.head = head;
      Ask(id, other);
    }
    return other.ears;
  }

  // Moves a listener beside the first.
  void MoveListener(const std::string& id, const Pose& pose) {
    const auto found = others_.find(id);
    if (found == others_.end()) return;
    found->second.pose = pose;
    found->second.moved = true;
  }

  void RemoveListener(const std::string& id) {
    if (others_.erase(id) > 0) Order(message::RemoveListener(id));
  }

  // Adds an emitter, or moves the one with this id. Another clip than before begins anew.
  void SetEmitter(const std::string& id, const Source& source) {
    const auto found = emitters_.find(id);
    if (found != emitters_.end() && found->second.source.clip == source.clip) {
      Emitter& emitter = found->second;
      if (emitter.source.gain_db != source.gain_db) Order(message::SetGain(id, source.gain_db), id);
      emitter.source = source;
      emitter.moved = true;
      return;
    }
    if (found != emitters_.end()) RemoveEmitter(id);
    Emitter& emitter = emitters_[id];
    emitter.source = source;
    Prepare(emitter);
    Add(id, emitter);
  }

  // Plays a clip once, as soon as it can be heard or from a clock on. Returns the id of its emitter, which is removed once the clip and its
  // reverberation are over.
  std::string PlayOnce(const std::string& clip, const Pose& pose, double gain_db = 0, std::optional<std::uint64_t> start_at = std::nullopt) {
    Source source;
    source.clip = clip;
    source.pose = pose;
    source.gain_db = gain_db;
    source.loop = false;
    source.start_at = start_at;
    source.remove_when_ended = true;
    const std::string id = "shot" + std::to_string(++shots_);
    SetEmitter(id, source);
    return id;
  }

  // Moves an emitter that is there.
  void MoveEmitter(const std::string& id, const Pose& pose) {
    const auto found = emitters_.find(id);
    if (found == emitters_.end()) return;
    found->second.source.pose = pose;
    found->second.moved = true;
  }

  // Changes a gain over some seconds, linearly in decibels.
  void SetGain(const std::string& id, double gain_db, double ramp_s = 0) {
    const auto found = emitters_.find(id);
    if (found == emitters_.end()) return;
    found->second.source.gain_db = gain_db;
    Order(message::SetGain(id, gain_db, ramp_s), id);
  }

  // Opens a door of the scene so far, from 0, shut, to 1. Call it with each frame while a door swings.
  void SetDoor(const std::string& door, double openness) {
    const auto found = doors_.find(door);
    if (found != doors_.end() && found->second == openness) return;
    doors_[door] = openness;
    if (state_ == State::kLive) {
      Order(message::SetDoor(door, openness));
    } else {
      doors_moved_.insert(door);
    }
  }

  // Lets a clip fade out from a clock on, or at once. on_emitter_ended follows.
  void StopEmitter(const std::string& id, double fade_s = 0.01, std::optional<std::uint64_t> stop_at = std::nullopt) {
    const auto found = emitters_.find(id);
    if (found == emitters_.end() || found->second.source.clip.empty()) return;
    found->second.is_stopped = true;
    Order(message::StopEmitter(id, fade_s, stop_at, clock_offset_), id);
  }

  void RemoveEmitter(const std::string& id) {
    if (emitters_.erase(id) > 0) Order(message::RemoveEmitter(id), id);
  }

  // Chooses a quality level, or auto.
  void SetLevel(const std::string& level) {
    wanted_level_ = level;
    Order(message::SetLevel(level));
  }

  // Takes the next mono samples of a live emitter, at the output's rate. Returns false while it is not heard yet or if there is no room.
  bool PushDry(const std::string& id, const float* samples, std::size_t frames) {
    const auto found = emitters_.find(id);
    return found != emitters_.end() && found->second.is_heard && found->second.dry && found->second.dry->Push(samples, frames);
  }

  // ---- the connection, whose socket is another's

  // A connection is being made.
  void Begin() {
    if (state_ != State::kWaiting) Become(State::kConnecting);
    is_trying_ = true;
    silent_s_ = 0;
    last_error_ = Json();
  }

  std::string FirstMessage() const {
    if (CanResume()) return message::Resume(token_, snapshot_, ears_.has_block_ ? &newest_ : nullptr);
    return message::Hello(options_.scene, options_.sample_rate, options_.block_size, kEncoding, options_.buffer_blocks, listener_, wanted_level_, true,
                          std::max(options_.listeners, 1 + others_.size()));
  }

  // The connection has ended, with a close code if there was one, or there came none.
  void Lost(const std::string& why, int code = 0) {
    outgoing_.clear();
    is_trying_ = is_to_drop_ = false;
    const bool was_live = state_ == State::kLive;
    if (was_live) {
      attempt_ = 0;
      since_lost_s_ = 0;
    }
    problem_ = why;
    double advised_s = 0;
    if (last_error_.IsObject()) {
      problem_ = last_error_["code"].Text() + ": " + last_error_["message"].Text();
      advised_s = last_error_["retry_after_s"].Number();
      if (last_error_["code"].Text() == "unknown_resume_token" && CanResume()) {
        Forget();  // begins anew
        wait_s_ = 0;
        return;
      }
    }
    if (advised_s == 0 && (IsFinal(code) || (last_error_.IsObject() && !was_live))) return Become(State::kRefused);
    // With chance, so that the clients of a server that comes back do not all come at once.
    constexpr double kRetryS[] = {0.25, 0.5, 1, 2, 4, 8, 15};
    const double own_s = kRetryS[std::min(attempt_, 6)] * std::uniform_real_distribution<>(0.5, 1)(luck_);
    wait_s_ = advised_s > 0 ? advised_s : own_s;
    ++attempt_;
    Become(since_lost_s_ + wait_s_ <= options_.give_up_after_s ? State::kWaiting : State::kLost);
  }

  // Time passes. Returns what is to be done with the socket; kDrop is followed by Lost.
  Todo Step(double seconds) {
    step_s_ = seconds;
    since_block_s_ += seconds;
    if (state_ != State::kLive) since_lost_s_ += seconds;
    if (is_to_drop_) return Todo::kDrop;
    if (state_ == State::kWaiting && !is_trying_) {
      wait_s_ -= seconds;
      return wait_s_ <= 0 ? Todo::kConnect : Todo::kNothing;
    }
    if (is_trying_ || state_ == State::kLive) {
      silent_s_ += seconds;
      if (silent_s_ > kSilenceS) return Todo::kDrop;
    }
    if (state_ != State::kLive) return Todo::kNothing;
    since_ping_s_ += seconds;
    if (since_ping_s_ >= kPingIntervalS) {
      since_ping_s_ = 0;
      Say(message::Ping(++ping_id_));
    }
    for (auto& [id, emitter] : emitters_) {
      if (!emitter.is_refused || emitter.ask_again_s <= 0) continue;
      emitter.ask_again_s -= seconds;
      if (emitter.ask_again_s <= 0) Add(id, emitter);
    }
    for (auto& [id, other] : others_) {
      if (!other.is_refused) continue;
      other.ask_again_s -= seconds;
      if (other.ask_again_s <= 0) Ask(id, other);
    }
    since_poses_s_ += seconds;
    if (since_poses_s_ >= kPoseIntervalS) SayPoses();
    return Todo::kNothing;
  }

  // Takes a text message. One that is of no known type, or cannot be read, changes nothing.
  void Receive(std::string_view text) {
    silent_s_ = 0;
    const std::optional<Json> parsed = Json::Parse(text);
    if (!parsed) return;
    const Json& message = *parsed;
    const std::string &type = message["type"].Text(), &id = message["id"].Text();
    if (type == "welcome") {
      Welcome(message);
    } else if (type == "error") {
      Refused(message);
    } else if (type == "snapshot") {
      snapshot_ = message["snapshot"].Text();
      Handled(Count(message["handled"]));
    } else if (type == "level_changed") {
      LevelChanged(message["listener"].Text(), message["level"].Text());
    } else if (type == "pong") {
      if (message["id"].Number() == ping_id_) counts_.round_trip_s = since_ping_s_ + step_s_;
    } else if (type == "listener_added") {
      const bool is_news = Enter(id, static_cast<std::uint8_t>(Count(message["index"])));
      if (is_news && on_listener_added) on_listener_added(id);
    } else if (type == "emitter_added") {
      const auto found = emitters_.find(id);
      if (found == emitters_.end()) return;
      if (found->second.IsOver()) {
        Order(message::RemoveEmitter(id), id);  // the server goes by a snapshot from before it was heard, and begins it again
        TellEnded(End(found, true));
        return;
      }
      Open(found->second, Count(message["sample_clock"]));
      if (on_emitter_added) on_emitter_added(id);
    } else if (type == "emitter_ended") {
      const auto found = emitters_.find(id);
      if (found != emitters_.end()) TellEnded(End(found, message["removed"].Bool()));
    }
  }

  // Takes a binary message. Returns whether it was a block; another kind, or a damaged one, changes nothing.
  bool ReceiveBlock(const std::uint8_t* data, std::size_t size) {
    silent_s_ = 0;
    const std::optional<AudioBlock> parsed = ParseAudioBlock(data, size, kEncoding);
    if (!parsed || parsed->channels != 2 || !was_welcomed_) return false;
    const AudioBlock& block = *parsed;
    const auto whose = block.listener == 0 ? others_.end() : Numbered(block.listener);
    if (block.listener != 0 && whose == others_.end()) return true;  // of one that was removed meanwhile
    newest_.sequence = std::max(newest_.sequence, block.sequence);
    newest_.sample_clock = std::max(newest_.sample_clock, block.sample_clock);
    ++counts_.blocks;
    if (block.flags & kLate) ++counts_.blocks_late;
    since_block_s_ = 0;
    const bool is_to_be_acknowledged = block.sequence % kAcknowledgeEvery == kAcknowledgeEvery - 1;
    if (whose != others_.end()) {
      if (is_to_be_acknowledged) Say(message::Acknowledge(block.sequence, whose->first));
      counts_.blocks_skipped += whose->second.ears->Take(block);
      return true;
    }
    if (is_to_be_acknowledged) Say(message::Acknowledge(block.sequence));
    counts_.blocks_skipped += ears_.Take(block);
    sample_clock_ = ears_.next_clock_ + clock_offset_;
    heard_pose_id_ = block.pose_id;
    for (auto& [id, emitter] : emitters_) SendDry(id, emitter, block.sample_clock, block.samples.size() / 2);
    return true;
  }

  // The oldest message that is to be sent.
  std::optional<Outgoing> Take() {
    if (outgoing_.empty()) return std::nullopt;
    Outgoing first = std::move(outgoing_.front());
    outgoing_.pop_front();
    return first;
  }

  // Fills interleaved frames of both ears of the first listener, on the audio thread: no locks, no allocation.
  void Read(float* output, std::size_t frames) { ears_.Read(output, frames); }

 private:
  static constexpr Encoding kEncoding = Encoding::kInt16;
  static constexpr std::uint32_t kAcknowledgeEvery = 4;
  static constexpr std::uint64_t kBlocksAhead = 4;
  static constexpr std::uint8_t kLate = 2;
  static constexpr std::size_t kMostOrders = 1024, kMostWaiting = 4096;
  static constexpr double kPoseIntervalS = 0.012, kPingIntervalS = 1, kLiveTargetS = 0.04;
  static constexpr double kSilenceS = 4;  // a server that sends audio is never silent for so long

  // A message that the server counts.
  struct Ordered {
    std::string text;
    std::string emitter;       // the id of the one that it is about; empty if it is about none
    std::uint64_t number = 0;  // how many there were with this one since the stream began
    bool is_over = false;      // the emitter that it is about has ended, so that it is not sent again
  };

  struct Emitter {
    Source source;
    bool moved = false, is_heard = false, is_stopped = false, is_refused = false;
    bool was_heard = false;          // when a connection was lost
    bool has_ended = false;          // and the game was told so
    double ask_again_s = 0;          // after a refusal; 0 for never
    std::shared_ptr<Ordered> added;  // what adds it
    std::unique_ptr<Playback> dry;   // of a live one; from the output's rate to the stream's
    std::uint32_t sequence = 0;
    std::uint64_t start_clock = 0, sent_frames = 0;  // of the server

    bool PlaysOnce() const { return !source.clip.empty() && (!source.loop || is_stopped); }

    // Whether a server that does not have it is not to begin it again.
    bool IsOver() const { return has_ended || (PlaysOnce() && was_heard); }
  };

  // A listener beside the first.
  struct Other {
    std::shared_ptr<Ears> ears = std::make_shared<Ears>();  // the audio thread may keep them longer
    Pose pose;
    std::string head;
    bool moved = false, has_been = false, is_refused = false;
    double ask_again_s = 0;             // after a refusal
    std::shared_ptr<Ordered> added;      // what adds it
    std::optional<std::uint8_t> number;  // in the headers of its blocks, once the server has it
  };

  static std::uint64_t Count(const Json& number) { return static_cast<std::uint64_t>(std::max(0.0, number.Number())); }

  // Close codes after which a new connection would do no better.
  static bool IsFinal(int code) {
    return code == 1000 || code == 1002 || code == 1003 || (code >= 1007 && code <= 1010) || (code >= 4400 && code < 4500);
  }

  bool CanResume() const { return !token_.empty() || !snapshot_.empty(); }

  // Lets go of the stream that there was, so that the next connection begins anew.
  void Forget() {
    token_.clear();
    snapshot_.clear();
    orders_.clear();
    ordered_ = 0;
  }

  // Whether an emitter or a listener is there after so many orders.
  template <typename Added>
  static bool IsAmong(const Added& what, std::uint64_t handled) {
    return !what.added || what.added->number <= handled;
  }

  // The clip of an emitter is over. The server does not have the emitter any more if it `is_gone`. Returns its id where the game is to be told.
  std::vector<std::string> End(std::map<std::string, Emitter>::iterator found, bool is_gone) {
    std::vector<std::string> news;
    if (!found->second.has_ended) news.push_back(found->first);
    found->second.has_ended = true;
    if (is_gone) {
      EndOrders(found->second.added);
      emitters_.erase(found);
    }
    return news;
  }

  void TellEnded(const std::vector<std::string>& ids) {
    if (!on_emitter_ended) return;
    for (const std::string& id : ids) on_emitter_ended(id);
  }

  // A connection was lost, and the server of the next one lacks what was ordered after number `handled`. Emitters among that which play once,
  // and have ended or were heard, end here. Returns the ids of those of which the game is to be told.
  std::vector<std::string> EndWhatIsOver(std::uint64_t handled) {
    std::vector<std::string> ended;
    for (auto next = emitters_.begin(); next != emitters_.end();) {
      const auto found = next++;
      Emitter& emitter = found->second;
      if (emitter.is_heard && ears_.has_block_ && emitter.start_clock < ears_.next_clock_) emitter.was_heard = true;
      if (!emitter.IsOver() || IsAmong(emitter, handled)) continue;
      for (const std::string& id : End(found, true)) ended.push_back(id);
    }
    return ended;
  }

  void Become(State next) {
    if (state_ == next) return;
    state_ = next;
    if (on_state) on_state(next);
  }

  void Welcome(const Json& message) {
    sample_rate_ = static_cast<int>(message["sample_rate"].Number());
    level_ = message["level"].Text();
    token_ = message["resume_token"].Text();
    listener_moved_ = true;
    is_trying_ = false;
    attempt_ = 0;
    ears_.Open(sample_rate_, options_.output_rate, options_.target_s);
    ears_.level_ = level_;
    const Json& resumed = message["resumed"];
    if (resumed.IsObject() && Count(resumed["handled"]) < ordered_ - orders_.size()) {
      Forget();  // some of what was said is gone, so the stream begins anew
      is_to_drop_ = true;
      return;
    }
    if (was_welcomed_) ++counts_.reconnections;
    was_welcomed_ = true;
    state_ = State::kLive;  // so that what follows is said; the game is told once it has been
    std::vector<std::string> entered;
    if (resumed.IsObject()) {
      GoOn(Count(resumed["handled"]), Count(resumed["sample_clock"]), static_cast<std::uint32_t>(Count(resumed["pose_id"])));
      entered = GoOnHearing(Count(resumed["handled"]), resumed["listeners"]);
    } else {
      BeginAnew();
    }
    if (on_state) on_state(state_);
    if (!on_listener_added) return;
    for (const std::string& id : entered) on_listener_added(id);
  }

  // The server has the stream still, or goes by a snapshot of it: it gets what it has not handled, and where everything is now. What plays once
  // and was heard since the snapshot is not begun again.
  void GoOn(std::uint64_t handled, std::uint64_t clock, std::uint32_t pose_id) {
    ++counts_.resumptions;
    const std::vector<std::string> ended = EndWhatIsOver(handled);
    Handled(handled);
    DropOrders();
    for (const auto& each : orders_) outgoing_.push_back({true, each->text});
    for (const std::string& door : doors_moved_) Order(message::SetDoor(door, doors_[door]));
    doors_moved_.clear();
    pose_id_ = std::max(pose_id_, pose_id);
    for (auto& [id, emitter] : emitters_) {
      emitter.moved = true;
      if (!IsAmong(emitter, handled)) {
        emitter.is_heard = false;  // it is among what is sent again
      } else if (emitter.is_heard ? emitter.source.clip.empty() : !emitter.is_refused) {
        // That it is heard may have been said just before the connection was lost.
        const std::uint64_t start = emitter.source.start_at.value_or(0);
        Open(emitter, std::max(clock, start - std::min(start, clock_offset_)));
      }
    }
    TellEnded(ended);
  }

  // Listeners that the server has go on. Those that it should have and has not are asked for again. Returns the ids of those that are news.
  std::vector<std::string> GoOnHearing(std::uint64_t handled, const Json& there) {
    std::map<std::string, std::uint8_t> numbers;
    for (const Json& each : there.Items()) numbers[each["id"].Text()] = static_cast<std::uint8_t>(Count(each["index"]));
    std::vector<std::string> entered;
    for (auto& [id, other] : others_) {
      if (!IsAmong(other, handled)) continue;  // it is among what is sent again
      const auto found = numbers.find(id);
      if (found != numbers.end()) {
        // That it is there may have been said just before the connection was lost.
        if (Enter(id, found->second)) entered.push_back(id);
      } else if (other.number) {
        other.number.reset();  // an error says why it is gone
      } else if (!other.is_refused) {
        Ask(id, other);  // the answer was lost
      }
    }
    return entered;
  }

  // The stream is a new one of the server's, whose clock is at 0. What plays once and was heard is not begun again.
  void BeginAnew() {
    const std::vector<std::string> ended = EndWhatIsOver(0);
    if (ears_.has_block_) {
      const double away_s = std::max(0.0, since_block_s_ - static_cast<double>(options_.buffer_blocks * options_.block_size) / sample_rate_);
      clock_offset_ = sample_clock_ + static_cast<std::uint64_t>(away_s * sample_rate_);
    }
    ears_.BeginAnew();
    newest_ = AudioBlock();
    snapshot_.clear();
    orders_.clear();
    ordered_ = 0;
    pose_id_ = 0;
    // Not in the hello: a door that the scene lacks would end the stream.
    for (const auto& [door, openness] : doors_) Order(message::SetDoor(door, openness));
    doors_moved_.clear();
    for (auto& [id, other] : others_) {  // before what they are to hear from its beginning
      other.number.reset();
      other.ears->BeginAnew();
      Ask(id, other);
    }
    for (auto& [id, emitter] : emitters_) {
      Prepare(emitter);
      Add(id, emitter);
    }
    TellEnded(ended);
  }

  void Prepare(Emitter& emitter) {
    emitter.is_heard = emitter.was_heard = emitter.moved = false;
    emitter.sequence = 0;
    if (emitter.source.clip.empty() && sample_rate_ > 0) {
      emitter.dry = std::make_unique<Playback>(1, options_.output_rate, sample_rate_, kLiveTargetS);
    }
  }

  // The server hears the emitter from a clock on, and has no samples of it yet.
  static void Open(Emitter& emitter, std::uint64_t clock) {
    emitter.is_heard = true;
    emitter.start_clock = clock;
    emitter.sent_frames = 0;
  }

  void Add(const std::string& id, Emitter& emitter) {
    emitter.is_refused = false;
    emitter.added = Order(message::AddEmitter(id, emitter.source, clock_offset_), id);
  }

  void Ask(const std::string& id, Other& other) {
    other.is_refused = false;
    other.added = Order(message::AddListener(id, other.pose, other.head));
  }

  // The server has a listener beside the first, under this number. Returns whether that is news.
  bool Enter(const std::string& id, std::uint8_t number) {
    const auto found = others_.find(id);
    if (found == others_.end()) return false;  // removed meanwhile
    Other& other = found->second;
    const bool is_new = !other.number;
    other.number = number;
    other.has_been = other.moved = true;
    other.ears->level_ = level_;
    other.ears->Open(sample_rate_, options_.output_rate, options_.target_s);
    return is_new;
  }

  std::map<std::string, Other>::iterator Numbered(std::uint8_t number) {
    return std::find_if(others_.begin(), others_.end(), [number](const auto& pair) { return pair.second.number == number; });
  }

  void LevelChanged(const std::string& listener, const std::string& level) {
    if (listener.empty()) {
      level_ = ears_.level_ = level;
    } else if (const auto found = others_.find(listener); found != others_.end()) {
      found->second.ears->level_ = level;
    }
  }

  // Takes an error about a listener. One who comes back with a new connection is asked for again when the server says; any other is
  // forgotten. Returns whether it was.
  bool RefusedListener(const std::string& id, const Json& error) {
    const auto found = others_.find(id);
    if (found == others_.end() || found->second.number || error["code"].Text() == "unknown_listener") return false;
    Other& other = found->second;
    other.ask_again_s = error["retry_after_s"].Number();
    if (other.has_been && other.ask_again_s > 0) {
      other.is_refused = true;
      return false;
    }
    others_.erase(found);
    if (on_listener_refused) on_listener_refused(id, problem_);
    return true;
  }

  // A server that is too old to know what was asked does not say about whom it speaks. Had it not known another message, it would have the
  // listener, who is removed for that.
  void RefusedUnnamed(const Json& error) {
    const auto found = std::find_if(others_.begin(), others_.end(), [](const auto& pair) { return !pair.second.number && !pair.second.is_refused; });
    if (found == others_.end()) return;
    const std::string id = found->first;
    if (RefusedListener(id, error)) Order(message::RemoveListener(id));
  }

  void Refused(const Json& error) {
    problem_ = error["code"].Text() + ": " + error["message"].Text();
    if (!error["listener"].Text().empty()) {
      RefusedListener(error["listener"].Text(), error);
      return;
    }
    const std::string& id = error["emitter"].Text();
    if (id.empty()) {
      if (error["code"].Text() == "unknown_message") RefusedUnnamed(error);
      last_error_ = error;
      return;
    }
    const auto found = emitters_.find(id);
    if (found == emitters_.end()) return;
    Emitter& emitter = found->second;
    if (!emitter.is_heard) {
      emitter.is_refused = true;
      emitter.ask_again_s = error["retry_after_s"].Number();
      if (on_emitter_refused) on_emitter_refused(id, problem_);
    } else if (error["code"].Text() == "unknown_emitter" && emitter.PlaysOnce()) {
      TellEnded(End(found, true));  // its end was said just before the connection was lost
    }
  }

  // The first listener has got a block of so many frames at a clock.
  void SendDry(const std::string& id, Emitter& emitter, std::uint64_t clock, std::uint64_t frames) {
    if (!emitter.source.clip.empty() || !emitter.is_heard || clock < emitter.start_clock) return;
    // The server's clock counts: as many samples as it has rendered, and a few blocks ahead.
    const std::uint64_t due = clock - emitter.start_clock + (1 + kBlocksAhead) * frames;
    for (; emitter.sent_frames < due; emitter.sent_frames += frames) {
      dry_.resize(frames);
      emitter.dry->Read(dry_.data(), frames);
      const std::vector<std::uint8_t> bytes = SerializeDryBlock(id, emitter.sequence++, dry_.data(), frames, kEncoding);
      SayBinary(bytes.data(), bytes.size());
    }
  }

  void SayPoses() {
    since_poses_s_ = 0;
    for (auto& [id, emitter] : emitters_) {
      if (!emitter.moved || emitter.is_refused) continue;
      emitter.moved = false;
      Say(message::MoveEmitter(id, ++pose_id_, emitter.source.pose));
    }
    for (auto& [id, other] : others_) {
      if (!other.moved || !other.number) continue;
      other.moved = false;
      const auto bytes = SerializeListener(++pose_id_, other.pose, *other.number);
      SayBinary(bytes.data(), bytes.size());
    }
    if (!listener_moved_) return;
    listener_moved_ = false;
    const auto bytes = SerializeListener(++pose_id_, listener_);
    SayBinary(bytes.data(), bytes.size());
  }

  // Says what the server counts: now, or once the stream is resumed. A stream that is yet to begin is told all that is wanted when it does.
  // `emitter` is the id of the one that the message is about. Returns null for what is not said.
  std::shared_ptr<Ordered> Order(const std::string& text, const std::string& emitter = {}) {
    if (state_ != State::kLive && !CanResume()) return nullptr;
    orders_.push_back(std::make_shared<Ordered>(Ordered{text, emitter, ++ordered_, false}));
    if (orders_.size() > kMostOrders) orders_.pop_front();
    if (state_ == State::kLive) outgoing_.push_back({true, text});
    return orders_.back();
  }

  // The emitter that an order has added is over and gone: if the order is kept still, neither it nor what was said of the emitter since is sent
  // again.
  void EndOrders(const std::shared_ptr<Ordered>& added) {
    if (std::find(orders_.begin(), orders_.end(), added) == orders_.end()) return;
    for (const auto& each : orders_) each->is_over |= each->emitter == added->emitter && each->number >= added->number;
  }

  // Lets go of orders that are over. The others have the numbers by which the server is going to count them.
  void DropOrders() {
    ordered_ -= orders_.size();
    orders_.erase(std::remove_if(orders_.begin(), orders_.end(), [](const auto& each) { return each->is_over; }), orders_.end());
    for (const auto& each : orders_) each->number = ++ordered_;
  }

  // So many orders need not be sent again.
  void Handled(std::uint64_t count) {
    while (!orders_.empty() && ordered_ - orders_.size() < count) orders_.pop_front();
  }

  // Says what a lost connection makes idle.
  void Say(std::string text) {
    if (state_ == State::kLive && outgoing_.size() < kMostWaiting) outgoing_.push_back({true, std::move(text)});
  }

  void SayBinary(const std::uint8_t* data, std::size_t size) {
    if (state_ == State::kLive && outgoing_.size() < kMostWaiting) outgoing_.push_back({false, std::string(reinterpret_cast<const char*>(data), size)});
  }

  const SessionOptions options_;
  State state_ = State::kConnecting;
  std::string problem_, level_, wanted_level_;
  Statistics counts_;
  Pose listener_;
  bool listener_moved_ = false, is_trying_ = false, was_welcomed_ = false;
  bool is_to_drop_ = false;  // a connection that resumed a stream which cannot go on
  std::map<std::string, Other> others_;  // listeners beside the first
  std::map<std::string, Emitter> emitters_;
  std::map<std::string, double> doors_;  // those that the game has moved
  std::set<std::string> doors_moved_;    // of them, while there was no connection
  std::deque<Outgoing> outgoing_;
  std::deque<std::shared_ptr<Ordered>> orders_;  // the newest messages that the server counts, and how many there were
  std::uint64_t ordered_ = 0;
  std::string token_, snapshot_;  // with which the stream is resumed
  Json last_error_;               // of the whole stream, in this connection
  int attempt_ = 0, sample_rate_ = 0, shots_ = 0;
  double wait_s_ = 0, since_lost_s_ = 0, since_block_s_ = 0, since_ping_s_ = 0, since_poses_s_ = 0, silent_s_ = 0;
  double step_s_ = 0;  // to which time is known
  std::uint32_t pose_id_ = 0, ping_id_ = 0, heard_pose_id_ = 0;
  AudioBlock newest_;  // the greatest sequence and clock of all listeners' blocks since the stream began
  std::uint64_t clock_offset_ = 0, sample_clock_ = 0;  // what is added to the server's clock; the stream's
  std::vector<float> dry_;
  Ears ears_;  // of the first listener
  std::mt19937 luck_{std::random_device{}()};
};

}  // namespace nafir
