// Plays a stream by client_examples/unreal for test_engine_losses.py, and writes what a sound card would play (float32, stereo, 48 kHz) to a
// file. Says meanwhile what becomes of it, and how many samples had been heard by then. While the connection is lost, it adds an emitter. A SHOT
// is as in UnityDriver.cs.
//
//   unreal_losses HOST PORT CLIP SECONDS OUTPUT GIVE_UP_AFTER_S [SHOT]

#include <algorithm>
#include <chrono>
#include <cstdio>
#include <cstdlib>
#include <set>
#include <string>
#include <vector>

#include "PosixStream.h"

int main(int count, char** words) {
  constexpr double kRate = 48000;
  constexpr std::size_t kFrames = 480;
  const std::string clip = words[3];
  const double seconds = std::atof(words[4]);
  std::string shot = count > 7 ? words[7] : "";
  nafir::SessionOptions options;
  options.scene = "flat";
  options.sample_rate = static_cast<int>(kRate);
  options.output_rate = kRate;
  options.give_up_after_s = std::atof(words[6]);
  nafir::Session session(options);
  int played = 0;
  bool is_over = false;
  nafir::Source source, late;
  source.clip = late.clip = clip;
  source.pose.position = nafir::PositionFromUnreal({600, -300, 150});
  late.pose = source.pose;
  late.gain_db = -70;
  session.on_state = [&](nafir::State state) {
    std::printf("state %s %d %s\n", NameOf(state), played, session.problem().c_str());
    std::fflush(stdout);
    if (state == nafir::State::kWaiting) session.SetEmitter("late", late);
    is_over = state == nafir::State::kLost || state == nafir::State::kRefused;
  };
  session.on_emitter_added = [](const std::string& id) {
    std::printf("emitter_added %s\n", id.c_str());
    std::fflush(stdout);
  };
  session.on_emitter_ended = [](const std::string& id) {
    std::printf("ended %s\n", id.c_str());
    std::fflush(stdout);
  };
  if (!shot.empty()) source.gain_db = -70;
  session.SetListener(nafir::FromUnreal({200, -250, 150}, {}));
  session.SetEmitter("source", source);
  PosixStream stream(session, words[1], words[2], "");

  std::FILE* const file = std::fopen(words[5], "wb");
  std::vector<float> ears(2 * kFrames);
  double fullest_s = 0;
  const auto began = std::chrono::steady_clock::now();
  for (int quantum = 1; quantum * kFrames <= seconds * kRate && !is_over; ++quantum) {
    stream.ReceiveUntil(began + std::chrono::microseconds(static_cast<std::int64_t>(1e6 * quantum * kFrames / kRate)));
    stream.Step(kFrames / kRate);
    if (!shot.empty() && session.FirstMessage().find("\"snapshot\":\"") != std::string::npos) {
      nafir::Source once;
      once.clip = shot;
      once.pose.position = nafir::PositionFromUnreal({200, -250, 150});
      once.loop = false;
      session.SetEmitter("heard", once);
      once.offset_s = 5;
      session.SetEmitter("stays", once);
      once.remove_when_ended = true;
      session.SetEmitter("over", once);
      shot.clear();
    }
    session.Read(ears.data(), kFrames);
    std::fwrite(ears.data(), sizeof(float), ears.size(), file);
    played += static_cast<int>(kFrames);
    if (played > (seconds - 1) * kRate) fullest_s = std::max(fullest_s, session.statistics().waiting_s);
  }
  std::fclose(file);
  stream.Close();
  const nafir::Statistics counts = session.statistics();
  std::printf("end %s %u %u %u %.3f %.4f %llu %s\n", NameOf(session.state()), counts.reconnections, counts.resumptions, counts.underruns, fullest_s,
              counts.round_trip_s, static_cast<unsigned long long>(session.sample_clock()), session.level().c_str());
}
