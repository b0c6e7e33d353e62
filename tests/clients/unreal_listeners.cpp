// Plays a stream with several listeners by client_examples/unreal for test_engine_listeners.py: a player, a guest near the clip, and one with
// a head that there is not. Says who came and went and what became of the stream, plays until it was lost and is live again, and says how
// loud player and guest were in half a second: before the loss, after it, after the guest was moved to the player, and after it left. Each
// time it waits until that is as it should be, thirty seconds at most.
//
//   unreal_listeners HOST PORT CLIP

#include <chrono>
#include <cmath>
#include <cstdio>
#include <functional>
#include <memory>
#include <string>
#include <utility>
#include <vector>

#include "PosixStream.h"

namespace {

constexpr double kRate = 48000, kHeard = 1e-3;
constexpr std::size_t kFrames = 480;

void Say(const std::string& line) {
  std::printf("%s\n", line.c_str());
  std::fflush(stdout);
}

nafir::Pose At(double x_m) { return nafir::FromUnreal({100 * x_m, -250, 150}, {}); }

}  // namespace

int main(int, char** words) {
  nafir::SessionOptions options;
  options.scene = "flat";
  options.sample_rate = static_cast<int>(kRate);
  options.output_rate = kRate;
  options.listeners = 2;
  nafir::Session session(options);
  bool has_joined = false, was_refused = false, was_lost = false, is_back = false;
  session.on_state = [&](nafir::State state) {
    Say(std::string("state ") + NameOf(state));
    was_lost = was_lost || state == nafir::State::kWaiting;
    is_back = is_back || (was_lost && state == nafir::State::kLive);
  };
  session.on_listener_added = [&](const std::string& id) {
    Say("joined " + id);
    has_joined = true;
  };
  session.on_listener_refused = [&](const std::string& id, const std::string& why) {
    Say("refused " + id + " " + why.substr(0, why.find(':')));
    was_refused = true;
  };
  session.SetListener(At(1));
  const std::shared_ptr<nafir::Ears> guest = session.AddListener("guest", At(4.5));
  session.AddListener("nobody", At(3), "no such head");
  nafir::Source source;
  source.clip = words[3];
  source.pose = At(5);
  session.SetEmitter("source", source);
  PosixStream stream(session, words[1], words[2], "");

  const auto began = std::chrono::steady_clock::now();
  int quantum = 0;
  std::vector<float> ears(2 * kFrames);
  const auto level = [&](auto& from) {
    from.Read(ears.data(), kFrames);
    double energy = 0;
    for (const float each : ears) energy += each * each;
    return energy / static_cast<double>(ears.size());
  };
  // Plays until something has happened, or for so many hundredths of a second. Returns the levels of player and guest.
  const auto play = [&](int longest, const std::function<bool()>& has_happened) {
    double own = 0, other = 0;
    int played = 0;
    for (; played < longest && !has_happened(); ++played) {
      stream.ReceiveUntil(began + std::chrono::microseconds(static_cast<std::int64_t>(1e6 * ++quantum * kFrames / kRate)));
      stream.Step(kFrames / kRate);
      own += level(session);
      other += level(*guest);
    }
    return std::pair(std::sqrt(own / played), std::sqrt(other / played));
  };
  const auto never = [] { return false; };
  std::string levels;
  const auto await = [&](const std::function<bool(double, double)>& is_so) {
    std::pair<double, double> found;
    for (int tries = 0; tries < 60; ++tries) {
      found = play(50, never);
      if (found.first > kHeard && is_so(found.first, found.second)) break;
    }
    levels += " " + std::to_string(found.first) + " " + std::to_string(found.second);
  };
  const auto are_apart = [](double own, double other) { return other > 2 * own; };
  play(3000, [&] { return has_joined && was_refused; });
  await(are_apart);
  Say("heard");
  play(3000, [&] { return is_back; });
  play(25, never);  // what waited to be played
  await(are_apart);
  session.MoveListener("guest", At(1));
  await([](double own, double other) { return std::abs(other / own - 1) < 0.2; });
  session.RemoveListener("guest");
  await([](double, double other) { return other == 0; });
  stream.Close();
  const nafir::Statistics counts = session.statistics();
  Say(std::string("end ") + NameOf(session.state()) + " " + std::to_string(counts.reconnections) + " " + std::to_string(counts.resumptions) + levels);
}
