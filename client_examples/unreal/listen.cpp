// Hears a scene without Unreal: the headers in Nafir/ with a WebSocket of POSIX. It walks two metres past a clip and prints the level of both
// ears ten times a second, as a sound card would play them. A lost connection is made again.
//
//   g++ -std=c++17 client_examples/unreal/listen.cpp -o listen && ./listen 127.0.0.1 8000 apartment [CLIP [SECONDS [KEY]]]

#include <chrono>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <string>
#include <vector>

#include "Nafir/Pose.h"
#include "Nafir/Session.h"
#include "PosixStream.h"

int main(int count, char** words) {
  const std::string host = count > 1 ? words[1] : "127.0.0.1", port = count > 2 ? words[2] : "8000";
  const std::string clip = count > 4 ? words[4] : "woman-reading", key = count > 6 ? words[6] : "";
  const double seconds = count > 5 ? std::atof(words[5]) : 5;
  constexpr double kRate = 48000;
  constexpr std::size_t kFrames = 480;

  nafir::SessionOptions options;
  options.scene = count > 3 ? words[3] : "apartment";
  options.sample_rate = static_cast<int>(kRate);
  options.output_rate = kRate;
  nafir::Session session(options);
  // In the units and axes of Unreal: at x = 200 cm, y = -250 cm, 150 cm above the floor, looking east.
  nafir::Vector location{200, -250, 150};
  nafir::Source source;
  source.clip = clip;
  source.pose.position = nafir::PositionFromUnreal({600, -300, 150});
  session.SetListener(nafir::FromUnreal(location, {}));
  session.SetEmitter("clip", source);

  PosixStream stream(session, host, port, key);
  std::vector<float> ears(2 * kFrames);
  double energy[2] = {0, 0};
  const auto began = std::chrono::steady_clock::now();
  // A sound card asks for so many samples at such times.
  for (int quantum = 1; quantum * kFrames <= seconds * kRate; ++quantum) {
    const auto due = began + std::chrono::microseconds(static_cast<std::int64_t>(1e6 * quantum * kFrames / kRate));
    stream.ReceiveUntil(due);
    location.x = 200 + 200 * quantum * kFrames / (seconds * kRate);
    session.SetListener(nafir::FromUnreal(location, {}));
    stream.Step(kFrames / kRate);
    if (session.state() == nafir::State::kRefused || session.state() == nafir::State::kLost) break;

    session.Read(ears.data(), kFrames);
    for (std::size_t i = 0; i < ears.size(); ++i) energy[i % 2] += ears[i] * ears[i];
    if (quantum % 10 != 0) continue;
    std::printf("%.2f s  left %.5f  right %.5f  pose %u  %s\n", quantum * kFrames / kRate, std::sqrt(energy[0] / (10 * kFrames)),
                std::sqrt(energy[1] / (10 * kFrames)), session.heard_pose_id(), nafir::NameOf(session.state()));
    std::fflush(stdout);  // into a pipe, too
    energy[0] = energy[1] = 0;
  }
  if (session.state() == nafir::State::kLive) {
    stream.Close();
    return 0;
  }
  std::fprintf(stderr, "%s\n", session.problem().c_str());
  return 1;
}
