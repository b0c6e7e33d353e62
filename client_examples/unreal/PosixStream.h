// A session of Nafir/ with its socket, for programs without an engine: what the component does with Unreal's.
#pragma once

#include <chrono>
#include <string>
#include <utility>
#include <vector>

#include "Nafir/Session.h"
#include "PosixWebSocket.h"

class PosixStream {
 public:
  using Clock = std::chrono::steady_clock;

  PosixStream(nafir::Session& session, std::string host, std::string port, std::string key)
      : session_(session), host_(std::move(host)), port_(std::move(port)), key_(std::move(key)) {
    Connect();
  }

  // Receives until a time.
  void ReceiveUntil(Clock::time_point due) {
    for (;;) {
      const auto left = std::chrono::duration_cast<std::chrono::milliseconds>(due - Clock::now()).count();
      if (left < 0) return;
      const int patience_ms = static_cast<int>(left) + 1;
      if (!socket_.is_open()) {
        poll(nullptr, 0, patience_ms);
        continue;
      }
      switch (socket_.Receive(data_, patience_ms)) {
        case PosixWebSocket::kText: session_.Receive({reinterpret_cast<const char*>(data_.data()), data_.size()}); break;
        case PosixWebSocket::kBinary: session_.ReceiveBlock(data_.data(), data_.size()); break;
        case PosixWebSocket::kEnd: session_.Lost(socket_.why(), socket_.close_code()); break;
        default: break;
      }
    }
  }

  // So much time has passed. Sends what is to be said, and connects again when it is time.
  void Step(double seconds) {
    switch (session_.Step(seconds)) {
      case nafir::Session::Todo::kDrop:
        socket_.Drop();
        session_.Lost("the server is silent");
        break;
      case nafir::Session::Todo::kConnect: Connect(); break;
      case nafir::Session::Todo::kNothing: break;
    }
    while (const auto message = session_.Take()) {
      socket_.Send(message->is_text ? PosixWebSocket::kText : PosixWebSocket::kBinary, message->data.data(), message->data.size());
    }
  }

  // Leaves for good: the server keeps nothing.
  void Close() { socket_.Close(1000); }

 private:
  void Connect() {
    session_.Begin();
    if (socket_.Open(host_, port_, "/v1/stream", key_)) {
      socket_.Send(session_.FirstMessage());
    } else {
      session_.Lost(socket_.why());
    }
  }

  nafir::Session& session_;
  const std::string host_, port_, key_;
  PosixWebSocket socket_;
  std::vector<std::uint8_t> data_;
};
