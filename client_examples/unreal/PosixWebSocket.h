// The client's side of RFC 6455 by POSIX sockets, as much as programs without an engine need. One thread; no encryption.
#pragma once

#include <netdb.h>
#include <poll.h>
#include <sys/socket.h>
#include <unistd.h>

#include <cstdint>
#include <string>
#include <vector>

class PosixWebSocket {
 public:
  enum Kind { kNothing = -2, kEnd = -1, kText = 1, kBinary = 2, kClose = 8, kPing = 9, kPong = 10 };

  PosixWebSocket() = default;
  ~PosixWebSocket() { Drop(); }
  PosixWebSocket(const PosixWebSocket&) = delete;
  PosixWebSocket& operator=(const PosixWebSocket&) = delete;

  // Connects, in place of any connection before. Returns false with a why() if that fails.
  bool Open(const std::string& host, const std::string& port, const std::string& path, const std::string& key) {
    Drop();
    close_code_ = 0;
    addrinfo hints{}, *found = nullptr;
    hints.ai_socktype = SOCK_STREAM;
    if (getaddrinfo(host.c_str(), port.c_str(), &hints, &found) != 0) return Fail("no such host: " + host);
    socket_ = socket(found->ai_family, found->ai_socktype, found->ai_protocol);
    const bool is_there = connect(socket_, found->ai_addr, found->ai_addrlen) == 0;
    freeaddrinfo(found);
    if (!is_there) return Fail("nobody listens at " + host + ":" + port);
    const std::string authorization = key.empty() ? "" : "Authorization: Bearer " + key + "\r\n";
    Write("GET " + path + " HTTP/1.1\r\nHost: " + host + ":" + port +
          "\r\nUpgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\nSec-WebSocket-Key: bmFmaXIgbmFmaXIgbmFmaQ==\r\n" +
          authorization + "\r\n");
    for (;;) {
      if (!Fill(kHandshakeMs)) return Fail("no answer from " + host + ":" + port);
      const std::string answer(received_.begin(), received_.end());
      const std::size_t end = answer.find("\r\n\r\n");
      if (end == std::string::npos) continue;
      if (answer.compare(0, 12, "HTTP/1.1 101") != 0) return Fail("refused: " + answer.substr(0, answer.find("\r\n")));
      received_.erase(received_.begin(), received_.begin() + static_cast<std::ptrdiff_t>(end) + 4);
      return true;
    }
  }

  bool is_open() const { return socket_ >= 0; }
  const std::string& why() const { return why_; }    // it ended
  int close_code() const { return close_code_; }     // of the server's close frame; 0 without one

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

  // The next text or binary message; kNothing if none has come within the time, kEnd once the connection has ended.
  Kind Receive(std::vector<std::uint8_t>& data, int patience_ms) {
    for (;;) {
      if (socket_ < 0) return kEnd;
      Kind kind = kNothing;
      if (TakeFrame(kind, data)) {
        if (kind == kText || kind == kBinary) return kind;
      } else if (!Fill(patience_ms)) {
        return socket_ < 0 ? kEnd : kNothing;
      }
    }
  }

  // Leaves with a close code.
  void Close(std::uint16_t code) {
    const std::uint8_t bytes[] = {static_cast<std::uint8_t>(code >> 8), static_cast<std::uint8_t>(code & 0xff)};
    if (socket_ >= 0) Send(kClose, bytes, sizeof bytes);
    Drop();
  }

  void Drop() {
    if (socket_ >= 0) close(socket_);
    socket_ = -1;
    received_.clear();
    message_.clear();
  }

 private:
  static constexpr int kHandshakeMs = 10000;

  bool Fail(const std::string& why) {
    why_ = why;
    Drop();
    return false;
  }

  void Write(const std::string& bytes) {
    for (std::size_t sent = 0; socket_ >= 0 && sent < bytes.size();) {
      const ssize_t some = send(socket_, bytes.data() + sent, bytes.size() - sent, MSG_NOSIGNAL);
      if (some <= 0) {
        Fail("the connection was lost");
        return;
      }
      sent += static_cast<std::size_t>(some);
    }
  }

  // Waits for bytes. Returns whether some came.
  bool Fill(int patience_ms) {
    pollfd waiting{socket_, POLLIN, 0};
    if (poll(&waiting, 1, patience_ms) <= 0) return false;
    std::uint8_t bytes[65536];
    const ssize_t some = recv(socket_, bytes, sizeof bytes, 0);
    if (some <= 0) return Fail("the connection was lost");
    received_.insert(received_.end(), bytes, bytes + some);
    return true;
  }

  // Takes a frame of what has been received, if a whole one is there. `kind` is that of the message that it completes, if it does.
  bool TakeFrame(Kind& kind, std::vector<std::uint8_t>& data) {
    if (received_.size() < 2) return false;
    std::uint64_t size = received_[1] & 0x7f;
    const std::size_t more = size == 126 ? 2 : size == 127 ? 8 : 0;
    if (received_.size() < 2 + more) return false;
    if (more > 0) size = 0;
    for (std::size_t i = 0; i < more; ++i) size = size << 8 | received_[2 + i];
    if (received_.size() < 2 + more + size) return false;
    const int first = received_[0], code = first & 0x0f;
    const auto begin = received_.begin() + static_cast<std::ptrdiff_t>(2 + more), end = begin + static_cast<std::ptrdiff_t>(size);
    const std::vector<std::uint8_t> part(begin, end);
    received_.erase(received_.begin(), end);
    if (code == kPing) Send(kPong, part.data(), part.size());
    if (code == kClose) {
      close_code_ = part.size() < 2 ? 1005 : part[0] << 8 | part[1];
      Fail("closed with " + std::to_string(close_code_) + ": " + std::string(part.begin() + (part.size() < 2 ? 0 : 2), part.end()));
    }
    if (code >= kClose) return true;
    if (code != 0) message_kind_ = static_cast<Kind>(code);
    message_.insert(message_.end(), part.begin(), part.end());
    if (first & 0x80) {
      kind = message_kind_;
      data.swap(message_);
      message_.clear();
    }
    return true;
  }

  int socket_ = -1, close_code_ = 0;
  std::string why_;
  std::vector<std::uint8_t> received_, message_;
  Kind message_kind_ = kText;
};
