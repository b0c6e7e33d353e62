// A buffer between the network and the audio thread: one thread pushes, another reads, neither waits and neither allocates.
// C++17, no types of Unreal.
//
// Where the sound has an end (the network stalls, blocks are missing, a lost stream goes on elsewhere) it fades out before and in after.
// Samples are read at the output's rate by cubic interpolation. The pace follows the fill by at most 0.2 % (three cents), which makes up
// for the difference between the server's clock and the sound card's.
#pragma once

#include <algorithm>
#include <atomic>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <limits>
#include <vector>

namespace nafir {

class Playback {
 public:
  // `target_s` is how much is held back: more copes with a worse network, less is heard sooner.
  Playback(unsigned channels, double stream_rate, double output_rate, double target_s = 0.06)
      : channels_(channels),
        stream_rate_(stream_rate),
        step_(stream_rate / output_rate),
        fade_(kFadeS * stream_rate),
        target_(std::max<double>(2 * fade_, target_s * stream_rate)),
        capacity_(static_cast<std::uint64_t>(target_ + kCapacityS * stream_rate)),
        ring_(capacity_ * channels) {}

  // Takes interleaved frames, on the thread of the network. Returns false if there is no room, because nobody reads.
  bool Push(const float* samples, std::size_t frames) {
    const std::uint64_t written = written_.load(std::memory_order_relaxed);
    if (written - read_.load(std::memory_order_acquire) + frames > capacity_) return false;
    for (std::size_t i = 0; i < frames; ++i) {
      std::copy_n(samples + i * channels_, channels_, ring_.begin() + static_cast<std::ptrdiff_t>((written + i) % capacity_ * channels_));
    }
    written_.store(written + frames, std::memory_order_release);
    return true;
  }

  // What is pushed next does not continue what was pushed before: fades out and in there, and holds back as much as at the beginning.
  void Break() {
    const unsigned count = seams_written_.load(std::memory_order_relaxed);
    if (count - seams_read_.load(std::memory_order_acquire) == kMostSeams) return;  // a network of nothing but gaps
    seams_[count % kMostSeams] = written_.load(std::memory_order_relaxed);
    seams_written_.store(count + 1, std::memory_order_release);
  }

  // Fills interleaved frames, on the audio thread; with silence until enough is there.
  void Read(float* output, std::size_t frames) {
    const std::uint64_t written = written_.load(std::memory_order_acquire);
    const double pace = step_ * (1 + Correction(static_cast<double>(written) - at_, frames));
    for (std::size_t i = 0; i < frames; ++i, output += channels_) {
      const double fill = static_cast<double>(written) - at_;
      if (!playing_ && fill >= target_) Start(written);
      const double seam = Seam();
      const double free = std::min(static_cast<double>(written), seam) - at_ - kNeighbours;
      if (!playing_ || free < pace) {
        const bool is_seam = seam <= static_cast<double>(written);
        if (is_seam) at_ = seam;
        if (playing_ && !is_seam) underruns_.fetch_add(1, std::memory_order_relaxed);
        playing_ = false;
        std::fill_n(output, channels_, 0.0F);
        continue;
      }
      // After a stall, too much comes at once: fades out, and goes on with the newest.
      if (fill > target_ + kMostS * stream_rate_) skipping_ = true;
      gain_ = skipping_ ? gain_ - 1.0 / fade_ : std::min({gain_ + 1.0 / fade_, free / fade_, 1.0});
      if (skipping_ && gain_ <= 0) {
        Start(written);
        skipping_ = false;
      }
      Interpolate(output);
      at_ += pace;
    }
    read_.store(static_cast<std::uint64_t>(std::max(0.0, std::floor(at_) - 1)), std::memory_order_release);
  }

  // How often the audio thread found too little.
  unsigned underruns() const { return underruns_.load(std::memory_order_relaxed); }

  // Seconds of sound that wait.
  double waiting_s() const {
    const std::uint64_t read = read_.load(std::memory_order_acquire), written = written_.load(std::memory_order_acquire);
    return written > read ? static_cast<double>(written - read) / stream_rate_ : 0;
  }

 private:
  static constexpr double kFadeS = 0.005, kNeighbours = 3, kCapacityS = 2, kMostS = 0.25;
  static constexpr unsigned kMostSeams = 16;
  static constexpr double kSmoothingS = 1, kCorrectionS = 10, kMostCorrection = 0.002;

  // Where the sound ends next, though more has been written.
  double Seam() {
    const unsigned count = seams_written_.load(std::memory_order_acquire);
    unsigned passed = seams_read_.load(std::memory_order_relaxed);
    while (passed != count && static_cast<double>(seams_[passed % kMostSeams]) <= at_) ++passed;
    seams_read_.store(passed, std::memory_order_release);
    return passed != count ? static_cast<double>(seams_[passed % kMostSeams]) : std::numeric_limits<double>::infinity();
  }

  void Start(std::uint64_t written) {
    at_ = static_cast<double>(written) - target_;  // older frames of the same burst would only add delay
    smooth_ = target_;
    gain_ = 0;
    playing_ = true;
  }

  double Correction(double fill, std::size_t frames) {
    if (!playing_) return 0;
    smooth_ += std::min(1.0, static_cast<double>(frames) * step_ / (kSmoothingS * stream_rate_)) * (fill - smooth_);
    return std::clamp((smooth_ - target_) / (kCorrectionS * stream_rate_), -kMostCorrection, kMostCorrection);
  }

  void Interpolate(float* output) const {
    const double whole = std::floor(at_);
    const float t = static_cast<float>(at_ - whole);
    const auto now = static_cast<std::uint64_t>(whole);
    const float* frame[4];
    for (std::uint64_t k = 0; k < 4; ++k) frame[k] = &ring_[(now + k + capacity_ - 1) % capacity_ * channels_];
    for (unsigned channel = 0; channel < channels_; ++channel) {
      const float a = frame[0][channel], b = frame[1][channel], c = frame[2][channel], d = frame[3][channel];
      const float slope = (c - a) / 2, next_slope = (d - b) / 2;
      const float curve = 3 * (c - b) - 2 * slope - next_slope, twist = 2 * (b - c) + slope + next_slope;
      output[channel] = static_cast<float>(gain_) * (b + t * (slope + t * (curve + t * twist)));
    }
  }

  const unsigned channels_;
  const double stream_rate_, step_, fade_, target_;
  const std::uint64_t capacity_;
  std::vector<float> ring_;
  std::atomic<std::uint64_t> written_{0}, read_{0};
  std::uint64_t seams_[kMostSeams] = {};  // frames before which the sound was interrupted
  std::atomic<unsigned> seams_written_{0}, seams_read_{0}, underruns_{0};
  // Of the audio thread alone; positions are frames since the first.
  double at_ = 0, smooth_ = 0, gain_ = 0;
  bool playing_ = false, skipping_ = false;
};

}  // namespace nafir
