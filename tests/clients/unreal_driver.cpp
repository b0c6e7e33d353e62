// Drives client_examples/unreal/Nafir for test_unreal.py: a command a line on standard input, an answer a line on standard output.

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <iostream>
#include <sstream>
#include <string>
#include <vector>

#include "Json.h"
#include "Playback.h"
#include "Pose.h"
#include "Session.h"
#include "Wire.h"

namespace {

template <typename Bytes>
std::string Hex(const Bytes& bytes) {
  std::string text;
  for (const std::uint8_t each : bytes) {
    char digits[3];
    std::snprintf(digits, sizeof digits, "%02x", each);
    text += digits;
  }
  return text;
}

std::vector<std::uint8_t> FromHex(const std::string& text) {
  std::vector<std::uint8_t> bytes;
  for (std::size_t i = 0; i + 1 < text.size(); i += 2) bytes.push_back(static_cast<std::uint8_t>(std::stoi(text.substr(i, 2), nullptr, 16)));
  return bytes;
}

nafir::Encoding EncodingOf(const std::string& name) { return name == "f32" ? nafir::Encoding::kFloat32 : nafir::Encoding::kInt16; }

nafir::Pose ReadPose(std::istream& in) {
  nafir::Pose pose;
  in >> pose.position.x >> pose.position.y >> pose.position.z;
  in >> pose.orientation.x >> pose.orientation.y >> pose.orientation.z >> pose.orientation.w;
  return pose;
}

void Print(const nafir::Pose& pose) {
  const auto& [p, q] = pose;
  std::cout << p.x << ' ' << p.y << ' ' << p.z << ' ' << q.x << ' ' << q.y << ' ' << q.z << ' ' << q.w;
}

std::string Written(const nafir::Json& value) {
  std::string text;
  switch (value.kind()) {
    case nafir::Json::Kind::kNull: return "null";
    case nafir::Json::Kind::kBool: return value.Bool() ? "true" : "false";
    case nafir::Json::Kind::kNumber: return nafir::wire::Number(value.Number());
    case nafir::Json::Kind::kText: return nafir::wire::Quoted(value.Text());
    case nafir::Json::Kind::kArray:
      for (const auto& each : value.Items()) text += (text.empty() ? "" : ",") + Written(each);
      return "[" + text + "]";
    default:
      for (const auto& [name, each] : value.Members()) text += (text.empty() ? "" : ",") + nafir::wire::Quoted(name) + ":" + Written(each);
      return "{" + text + "}";
  }
}

// A tone through the buffer: a sender's clock `skew` faster than the sound card's, which reads 512 frames at a time; blocks between
// `from_s` and `to_s` are held up until `to_s`. Answers with the underruns and the second channel.
void Play(std::istream& in) {
  double stream_rate, output_rate, skew, hertz, seconds, from_s, to_s;
  in >> stream_rate >> output_rate >> skew >> hertz >> seconds >> from_s >> to_s;
  nafir::Playback playback(2, stream_rate, output_rate);
  std::vector<float> block(2 * 256), output(2 * 512);
  std::size_t sent = 0;
  std::string heard;
  for (double now_s = 0; now_s < seconds; now_s += 512 / output_rate) {
    for (;;) {
      double due_s = static_cast<double>(sent + 256) / stream_rate / (1 + skew);
      if (due_s >= from_s && due_s < to_s) due_s = to_s;
      if (due_s > now_s) break;
      for (std::size_t i = 0; i < 256; ++i) {
        block[2 * i] = 0;
        block[2 * i + 1] = static_cast<float>(0.5 * std::sin(2 * M_PI * hertz * static_cast<double>(sent + i) / stream_rate));
      }
      if (!playback.Push(block.data(), 256)) std::cerr << "no room\n";
      sent += 256;
    }
    playback.Read(output.data(), 512);
    for (std::size_t i = 0; i < 512; ++i) {
      heard += std::to_string(output[2 * i + 1]);
      heard += ' ';
    }
  }
  std::cout << playback.underruns() << ' ' << heard << '\n';
}

// More is ordered than is kept for a resumed stream, of which the server has handled so much. Answers with the kind of the first message,
// what is to be done once the stream is resumed, how many messages there are to say, and the first message after that connection is lost.
void Resume(std::istream& in) {
  std::string handled;
  in >> handled;
  const auto name = [](const std::string& message) { return nafir::Json::Parse(message)->operator[]("type").Text(); };
  const std::string welcome = R"({"type":"welcome","sample_rate":24000,"level":"standard","resume_token":"t")";
  nafir::Session session({});
  session.Begin();
  session.Receive(welcome + "}");
  nafir::Source source;
  source.clip = "trumpet";
  session.SetEmitter("x", source);
  for (int i = 0; i < 1100; ++i) session.SetGain("x", -0.01 * i);
  session.Lost("a cut");
  session.SetGain("x", -20);
  std::cout << name(session.FirstMessage()) << ' ';
  session.Step(2);
  session.Begin();
  session.Receive(welcome + R"(,"resumed":{"handled":)" + handled + R"(,"sample_clock":5000,"pose_id":0}})");
  std::cout << (session.Step(0.01) == nafir::Session::Todo::kDrop ? "drop " : "go on ");
  int said = 0;
  while (session.Take()) ++said;
  std::cout << said << ' ';
  session.Lost("another");
  std::cout << name(session.FirstMessage()) << '\n';
}

// A door is moved before there is a stream, twice to the same place while there is one, and twice while it is lost; the stream is resumed,
// and then begins anew. Answers with what is said of doors after each of these, a line each.
void Doors() {
  nafir::Session session({});
  const auto tell = [&session] {
    std::string said;
    while (const auto message = session.Take()) {
      const auto read = nafir::Json::Parse(message->data);
      if (message->is_text && (*read)["type"].Text() == "set_door") {
        said += (*read)["door"].Text() + '=' + nafir::wire::Number((*read)["openness"].Number()) + ' ';
      }
    }
    std::cout << said << '\n';
  };
  const std::string welcome = R"({"type":"welcome","sample_rate":24000,"level":"standard","resume_token":"t")";
  session.SetDoor("kitchen", 0.75);
  session.Begin();
  session.Receive(welcome + "}");
  tell();
  session.SetDoor("kitchen", 0.5);
  session.SetDoor("kitchen", 0.5);
  session.SetDoor("attic", 1);
  tell();
  session.Lost("a cut");
  session.SetDoor("kitchen", 0.25);
  session.SetDoor("kitchen", 0);
  session.Begin();
  session.Receive(welcome + R"(,"resumed":{"handled":3,"sample_clock":5000,"pose_id":0}})");
  tell();
  session.Lost("another");
  session.Begin();
  session.Receive(welcome + "}");
  tell();
}

// Prints, in the order of the alphabet, what a game was told, and what its session has to say.
void Tell(nafir::Session& session, std::vector<std::string>& told) {
  while (const auto message = session.Take()) {
    const auto read = nafir::Json::Parse(message->data);
    if (!message->is_text) {
      told.push_back("pose:" + std::to_string(message->data[1]));
    } else {
      const std::string& id = (*read)["id"].Text();
      told.push_back((*read)["type"].Text() + ":" + (id.empty() ? (*read)["listener"].Text() : id));
    }
  }
  std::sort(told.begin(), told.end());
  for (const std::string& each : told) std::cout << each << ' ';
  std::cout << '\n';
  told.clear();
}

// A silent block of 256 frames of a listener, whose clock is 256 for each before it.
void Hear(nafir::Session& session, std::uint8_t number, std::uint8_t sequence) {
  std::vector<std::uint8_t> block(28 + 4 * 256);
  block[0] = 1;
  block[2] = 2;
  block[3] = number;
  block[4] = sequence;
  block[9] = sequence;
  block[25] = 1;
  session.ReceiveBlock(block.data(), block.size());
}

// Connects, and is welcomed.
void BeginStream(nafir::Session& session, const std::string& resumed) {
  session.Begin();
  session.Receive(R"({"type":"welcome","sample_rate":24000,"level":"standard","resume_token":"t")" + resumed + "}");
}

// Clips that play once, over the loss of their server. Answers with what is said and told in each step, a line each, as
// tests/clients/one_shots.py has it.
void OneShots() {
  nafir::Session session({});
  std::vector<std::string> told;
  session.on_emitter_ended = [&](const std::string& id) { told.push_back("ended:" + id); };
  const auto add = [&](const std::string& id, bool loop, std::optional<std::uint64_t> start_at = std::nullopt) {
    nafir::Source source;
    source.clip = "trumpet";
    source.loop = loop;
    source.start_at = start_at;
    source.remove_when_ended = id == "over";
    session.SetEmitter(id, source);
  };
  const auto added = [&](const std::string& id, int clock) {
    session.Receive(R"({"type":"emitter_added","id":")" + id + R"(","sample_clock":)" + std::to_string(clock) + "}");
  };
  const auto ended = [&](const std::string& id, bool removed) {
    session.Receive(R"({"type":"emitter_ended","id":")" + id + R"(","sample_clock":0,"removed":)" + (removed ? "true}" : "false}"));
  };
  BeginStream(session, "");
  add("loop", true);
  add("again", false);
  added("loop", 0);
  session.Receive(R"({"type":"snapshot","snapshot":"sealed","pose_id":0,"handled":2,"expires_s":120})");
  for (const char* id : {"over", "stays", "heard", "waiting"}) add(id, false);
  add("later", false, 1000000);
  for (const char* id : {"again", "over", "stays", "heard"}) added(id, 0);
  added("later", 1000000);
  session.SetGain("heard", -3);
  ended("over", true);
  ended("stays", false);
  Hear(session, 0, 0);
  Tell(session, told);
  session.Lost("a cut");
  BeginStream(session, R"(,"resumed":{"handled":2,"sample_clock":5000,"pose_id":0})");
  Tell(session, told);
  added("again", 5120);
  Tell(session, told);
  for (const char* id : {"again", "over", "heard"}) ended(id, true);
  Tell(session, told);
  session.Lost("another");
  BeginStream(session, R"(,"resumed":{"handled":4,"sample_clock":5376,"pose_id":0})");
  Tell(session, told);
  added("waiting", 6000);
  Hear(session, 0, 24);
  session.Lost("a third");
  BeginStream(session, "");
  Tell(session, told);
}

// A stream with other listeners, over everything that may become of them. Answers with what is said and told in each step, a line each, as
// tests/clients/guests.py has it.
void Guests() {
  nafir::Session session({});
  std::vector<std::string> told;
  session.on_listener_added = [&](const std::string& id) { told.push_back("added:" + id); };
  session.on_listener_refused = [&](const std::string& id, const std::string&) { told.push_back("refused:" + id); };
  const auto tell = [&] { Tell(session, told); };
  const auto hear = [&](std::uint8_t number, std::uint8_t sequence) { Hear(session, number, sequence); };
  const auto begin = [&](const std::string& resumed) { BeginStream(session, resumed); };
  const auto refuse = [&](const std::string& code, const std::string& more) {
    session.Receive(R"({"type":"error","code":")" + code + R"(","message":"no")" + more + "}");
  };
  session.AddListener("guest", {}, "kemar");
  std::cout << session.FirstMessage() << '\n';
  begin("");
  tell();
  session.Receive(R"({"type":"listener_added","id":"guest","index":7,"sample_clock":0})");
  session.Step(0.02);
  tell();
  hear(0, 3);
  hear(7, 7);
  hear(9, 11);  // of nobody
  tell();
  session.Receive(R"({"type":"level_changed","level":"fine","listener":"guest"})");
  std::cout << session.level() << ' ' << session.AddListener("guest", {})->level() << '\n';
  session.AddListener("unheard", {});
  session.AddListener("late", {});
  tell();
  session.Lost("a cut");
  std::cout << session.FirstMessage() << '\n';
  begin(R"(,"resumed":{"handled":2,"sample_clock":5000,"pose_id":0,"listeners":[{"id":"guest","index":7},{"id":"unheard","index":8}]})");
  tell();
  session.Lost("another");
  begin("");
  tell();
  refuse("server_busy", R"(,"listener":"guest","retry_after_s":0.5)");
  refuse("unknown_hrtf", R"(,"listener":"late")");
  refuse("unknown_listener", R"(,"listener":"unheard")");
  tell();
  session.Step(0.6);
  tell();
  refuse("unknown_message", "");
  tell();
}

}  // namespace

int main() {
  std::cout.precision(12);
  for (std::string line; std::getline(std::cin, line);) {
    std::istringstream in(line);
    std::string command, encoding, text;
    in >> command;
    if (command == "pose") {
      const nafir::Pose unreal = ReadPose(in);
      const nafir::Pose pose = nafir::FromUnreal(unreal.position, unreal.orientation);
      Print(pose);
      std::cout << ' ';
      Print({nafir::PositionToUnreal(pose.position), nafir::OrientationToUnreal(pose.orientation)});
      std::cout << '\n';
    } else if (command == "listener") {
      std::uint32_t pose_id;
      in >> pose_id;
      std::cout << Hex(nafir::SerializeListener(pose_id, ReadPose(in))) << '\n';
    } else if (command == "dry") {
      std::uint32_t sequence;
      in >> encoding >> text >> sequence;
      std::vector<float> samples;
      for (float each; in >> each;) samples.push_back(each);
      std::cout << Hex(nafir::SerializeDryBlock(text, sequence, samples.data(), samples.size(), EncodingOf(encoding))) << '\n';
    } else if (command == "block") {
      in >> encoding >> text;
      const auto bytes = FromHex(text);
      const auto block = nafir::ParseAudioBlock(bytes.data(), bytes.size(), EncodingOf(encoding));
      if (!block) {
        std::cout << "none\n";
        continue;
      }
      std::cout << block->sequence << ' ' << block->sample_clock << ' ' << block->pose_id << ' ' << block->reverberation_pose_id << ' '
                << int{block->flags} << ' ' << block->channels;
      for (const float each : block->samples) std::cout << ' ' << each;
      std::cout << '\n';
    } else if (command == "texts") {
      const nafir::Pose pose{{1.5, -2.25, 0.1}, {0, 0, 0.6, 0.8}};
      std::cout << nafir::message::Hello("flat \"1\"", 24000, 256, nafir::Encoding::kInt16, 4, pose) << '\n'
                << nafir::message::Hello("flat", 0, 512, nafir::Encoding::kFloat32, 8, pose) << '\n'
                << nafir::message::AddClip("a\\b\n", "trumpet", pose, -3.5, false) << '\n'
                << nafir::message::AddLive("npc-ä", pose) << '\n'
                << nafir::message::MoveEmitter("x", 4294967295U, pose) << '\n'
                << nafir::message::SetGain("x", -6) << '\n'
                << nafir::message::RemoveEmitter("x") << '\n'
                << nafir::message::Acknowledge(4294967295U) << '\n';
      nafir::AudioBlock last;
      last.sequence = 7;
      last.sample_clock = std::uint64_t{1} << 40;
      nafir::Source shot, repeated, voice;
      shot.clip = repeated.clip = "trumpet";
      shot.pose = repeated.pose = voice.pose = pose;
      shot.loop = false;
      shot.start_at = 5000;
      shot.stop_at = 100;
      shot.offset_s = 0.5;
      shot.remove_when_ended = true;
      repeated.loop_start_s = 0.25;
      repeated.loop_end_s = 1.5;
      voice.jitter_ms = 40;
      std::cout << nafir::message::Resume("a\"b", "", nullptr) << '\n'
                << nafir::message::Resume("", "c2ln", &last) << '\n'
                << nafir::message::AddEmitter("shot", shot, 1000) << '\n'
                << nafir::message::AddEmitter("loop", repeated) << '\n'
                << nafir::message::AddEmitter("voice", voice) << '\n'
                << nafir::message::StopEmitter("x", 0.5, 5000, 1000) << '\n'
                << nafir::message::StopEmitter("x", 0.01, std::nullopt) << '\n'
                << nafir::message::SetGain("x", -6, 2.5) << '\n'
                << nafir::message::SetLevel("auto") << '\n'
                << nafir::message::Ping(9) << '\n'
                << nafir::message::Hello("flat", 0, 512, nafir::Encoding::kInt16, 8, pose, "fine", true) << '\n'
                << nafir::message::SetDoor("north \"1\"", 0.25) << '\n';
    } else if (command == "json") {
      std::getline(in >> std::ws, text);
      const auto read = nafir::Json::Parse(text);
      std::cout << (read ? Written(*read) : "refused") << '\n';
    } else if (command == "play") {
      Play(in);
    } else if (command == "resume") {
      Resume(in);
    } else if (command == "doors") {
      Doors();
    } else if (command == "shots") {
      OneShots();
    } else if (command == "guests") {
      Guests();
    }
    std::cout.flush();
  }
}
