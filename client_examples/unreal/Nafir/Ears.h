// What one listener of a stream hears, on its way from the network to an audio thread. C++17, no types of Unreal. All but Read is for the
// thread of the session.
#pragma once

#include <algorithm>
#include <atomic>
#include <cstddef>
#include <cstdint>
#include <memory>
#include <string>
#include <vector>

#include "Playback.h"
#include "Wire.h"

namespace nafir {

class Ears {
 public:
  // Fills interleaved frames of both ears, on the audio thread: no locks, no allocation. Silent until the first block.
  void Read(float* output, std::size_t frames) {
    if (Playback* const from = playing_.load(std::memory_order_acquire)) {
      from->Read(output, frames);
    } else {
      std::fill_n(output, 2 * frames, 0.0F);
    }
  }

  unsigned underruns() const { return playbacks_.empty() ? 0 : playbacks_.back()->underruns(); }
  double waiting_s() const { return playbacks_.empty() ? 0 : playbacks_.back()->waiting_s(); }  // to be played
  const std::string& level() const { return level_; }  // the quality level that is heard; empty before there is one

 private:
  friend class Session;

  // Blocks are of this rate from now on.
  void Open(int stream_rate, double output_rate, double target_s) {
    if (stream_rate == stream_rate_) return;
    stream_rate_ = stream_rate;
    // The audio thread may be reading the last one still, so that it stays.
    playbacks_.push_back(std::make_unique<Playback>(2, stream_rate, output_rate, target_s));
    playing_.store(playbacks_.back().get(), std::memory_order_release);
  }

  // The next block is of another stream, whose clock is at 0.
  void BeginAnew() { has_block_ = false; }

  // Takes the next block, at the opened rate. Returns how many are missing before it.
  std::uint64_t Take(const AudioBlock& block) {
    const std::uint64_t frames = block.samples.size() / 2;
    if (!has_block_ || block.sample_clock != next_clock_) playbacks_.back()->Break();
    playbacks_.back()->Push(block.samples.data(), frames);
    const bool is_late = has_block_ && block.sample_clock > next_clock_ && frames > 0;
    const std::uint64_t missing = is_late ? (block.sample_clock - next_clock_) / frames : 0;
    has_block_ = true;
    next_clock_ = block.sample_clock + frames;
    return missing;
  }

  std::string level_;
  int stream_rate_ = 0;
  bool has_block_ = false;        // since the stream began
  std::uint64_t next_clock_ = 0;  // of the server, after the newest block
  std::vector<std::unique_ptr<Playback>> playbacks_;
  std::atomic<Playback*> playing_{nullptr};
};

}  // namespace nafir
