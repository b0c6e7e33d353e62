// Hears a scene without Unreal: a WebSocket of POSIX sockets around the headers in Nafir/. It walks two metres past a clip and prints the
// level of both ears ten times a second.
//
//   g++ -std=c++17 client_examples/unreal/listen.cpp -o listen && ./listen 127.0.0.1 8000 apartment [CLIP [SECONDS [KEY]]]

#include <netdb.h>
#include <sys/socket.h>
#include <unistd.h>

#include <cmath>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <string>
#include <vector>

#include "Nafir/Pose.h"
#include "Nafir/Wire.h"

namespace {

[[noreturn]] void Fail(const std::string& why) {
  std::fprintf(stderr, "%s\n", why.c_str());
  std::exit(1);
}

// The client's side of RFC 6455, as much as this program needs.
class WebSocket {
 public:
  enum Kind { kText = 1, kBinary = 2, kClose = 8, kPing = 9, kPong = 10 };

  WebSocket(const std::string& host, const std::string& port, const std::string& path, const std::string& key) {
    addrinfo hints{}, *found = nullptr;
    hints.ai_socktype = SOCK_STREAM;
    if (getaddrinfo(host.c_str(), port.c_str(), &hints, &found) != 0) Fail("no such host: " + host);
    socket_ = socket(found->ai_family, found->ai_socktype, found->ai_protocol);
    if (connect(socket_, found->ai_addr, found->ai_addrlen) != 0) Fail("nobody listens at " + host + ":" + port);
    freeaddrinfo(found);
    Write("GET " + path + " HTTP/1.1\r\nHost: " + host + ":" + port +
          "\r\nUpgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\nSec-WebSocket-Key: bmFmaXIgbmFmaXIgbmFmaQ==\r\n" + (key.empty() ? "" : "Authorization: Bearer " + key + "\r\n") + "\r\n");
    std::string answer;
    while (answer.size() < 4 || answer.compare(answer.size() - 4, 4, "\r\n\r\n") != 0) answer += static_cast<char>(ReadByte());
    if (answer.compare(0, 12, "HTTP/1.1 101") != 0) Fail("refused: " + answer);
  }
  ~WebSocket() { close(socket_); }
  WebSocket(const WebSocket&) = delete;

  void Send(Kind kind, const void* data, std::size_t size) {
    std::string frame{static_cast<char>(0x80 | kind)};
    if (size < 126) {
      frame += static_cast<char>(0x80 | size);
    } else {
      frame += static_cast<char>(0x80 | 126);
      frame += static_cast<char>(size >> 8);
      frame += static_cast<char>(size & 0xff);
    }
    frame.append(4, '\0');  // a mask of zeros leaves the bytes as they are
    frame.append(static_cast<const char*>(data), size);
    Write(frame);
  }
  void Send(const std::string& text) { Send(kText, text.data(), text.size()); }

  // The next text or binary message.
  Kind Receive(std::vector<std::uint8_t>& data) {
    data.clear();
    for (Kind kind = kText;;) {
      const int first = ReadByte();
      std::uint64_t size = ReadByte() & 0x7f;
      const int more = size == 126 ? 2 : size == 127 ? 8 : 0;
      if (more > 0) size = 0;
      for (int i = 0; i < more; ++i) size = size << 8 | static_cast<std::uint64_t>(ReadByte());
      std::vector<std::uint8_t> part(size);
      for (auto& each : part) each = static_cast<std::uint8_t>(ReadByte());
      const int code = first & 0x0f;
      if (code == kPing) Send(kPong, part.data(), part.size());
      if (code == kClose) Fail("closed: " + std::string(part.begin() + (part.size() < 2 ? 0 : 2), part.end()));
      if (code >= kClose) continue;
      if (code != 0) kind = static_cast<Kind>(code);
      data.insert(data.end(), part.begin(), part.end());
      if (first & 0x80) return kind;
    }
  }

 private:
  void Write(const std::string& bytes) {
    for (std::size_t sent = 0; sent < bytes.size();) {
      const ssize_t some = send(socket_, bytes.data() + sent, bytes.size() - sent, MSG_NOSIGNAL);
      if (some <= 0) Fail("the connection was lost");
      sent += static_cast<std::size_t>(some);
    }
  }

  int ReadByte() {
    if (at_ == buffered_) {
      const ssize_t some = recv(socket_, buffer_, sizeof buffer_, 0);
      if (some <= 0) Fail("the connection was lost");
      buffered_ = static_cast<std::size_t>(some);
      at_ = 0;
    }
    return buffer_[at_++];
  }

  int socket_;
  std::uint8_t buffer_[65536];
  std::size_t at_ = 0, buffered_ = 0;
};

// The stream's own rate: the welcome's last, after that of its scene. An engine has a reader of JSON.
double RateOf(const std::string& welcome) {
  const std::string key = "\"sample_rate\":";
  return std::strtod(welcome.c_str() + welcome.rfind(key) + key.size(), nullptr);
}

}  // namespace

int main(int count, char** words) {
  const std::string host = count > 1 ? words[1] : "127.0.0.1", port = count > 2 ? words[2] : "8000";
  const std::string scene = count > 3 ? words[3] : "apartment", clip = count > 4 ? words[4] : "woman-reading";
  const double seconds = count > 5 ? std::atof(words[5]) : 5;

  // In the units and axes of Unreal: at x = 200 cm, y = -250 cm, 150 cm above the floor, looking east.
  nafir::Vector location{200, -250, 150};
  const nafir::Quaternion ahead{0, 0, 0, 1};
  const auto encoding = nafir::Encoding::kInt16;

  WebSocket socket(host, port, "/v1/stream", count > 6 ? words[6] : "");
  socket.Send(nafir::message::Hello(scene, 0, 256, encoding, 8, nafir::FromUnreal(location, ahead)));
  double rate = 0, heard_s = 0, reported_s = 0, energy[2] = {0, 0};
  std::size_t frames = 0;
  std::uint32_t pose_id = 0;
  for (std::vector<std::uint8_t> data; heard_s < seconds;) {
    if (socket.Receive(data) == WebSocket::kText) {
      const std::string text(data.begin(), data.end());
      if (text.find("\"type\":\"error\"") != std::string::npos) Fail(text);
      if (text.find("\"type\":\"welcome\"") == std::string::npos) continue;
      rate = RateOf(text);
      const nafir::Vector source = nafir::PositionFromUnreal({600, -300, 150});
      socket.Send(nafir::message::AddClip("clip", clip, {source, {}}));
      continue;
    }
    const auto block = nafir::ParseAudioBlock(data.data(), data.size(), encoding);
    if (!block) continue;
    if (block->sequence % 4 == 3) {
      socket.Send(nafir::message::Acknowledge(block->sequence));
      location.x = 200 + 200 * heard_s / seconds;
      const auto pose = nafir::SerializeListener(++pose_id, nafir::FromUnreal(location, ahead));
      socket.Send(WebSocket::kBinary, pose.data(), pose.size());
    }
    const std::size_t count_frames = block->samples.size() / 2;
    for (std::size_t i = 0; i < block->samples.size(); ++i) energy[i % 2] += block->samples[i] * block->samples[i];
    frames += count_frames;
    heard_s += static_cast<double>(count_frames) / rate;
    if (heard_s - reported_s < 0.1) continue;
    std::printf("%.2f s  left %.5f  right %.5f  pose %u of %u\n", heard_s, std::sqrt(energy[0] / static_cast<double>(frames)),
                std::sqrt(energy[1] / static_cast<double>(frames)), block->pose_id, pose_id);
    reported_s = heard_s;
    energy[0] = energy[1] = 0;
    frames = 0;
  }
}
