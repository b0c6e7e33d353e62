// Reads JSON, as much as the server's messages are. C++17, no types of Unreal, no exceptions.
#pragma once

#include <cstdlib>
#include <map>
#include <optional>
#include <string>
#include <string_view>
#include <vector>

namespace nafir {

// A value. What is not there, or is of another kind, reads as empty, 0 or false.
class Json {
 public:
  enum class Kind { kNull, kBool, kNumber, kText, kArray, kObject };

  // The value that a text is; none if it is none.
  static std::optional<Json> Parse(std::string_view text) {
    Reader reader{text};
    Json value;
    if (!reader.Value(value, 0)) return std::nullopt;
    reader.Skip();
    if (reader.at != text.size()) return std::nullopt;
    return value;
  }

  const Json& operator[](const std::string& name) const {
    static const Json kNothing;
    const auto found = members_.find(name);
    return found == members_.end() ? kNothing : found->second;
  }
  const std::vector<Json>& Items() const { return items_; }
  const std::string& Text() const { return text_; }
  double Number() const { return number_; }
  bool Bool() const { return number_ != 0; }
  const std::map<std::string, Json>& Members() const { return members_; }
  Kind kind() const { return kind_; }
  bool IsObject() const { return kind_ == Kind::kObject; }

 private:
  static constexpr int kDeepest = 64;

  struct Reader {
    std::string_view text;
    std::size_t at = 0;

    void Skip() {
      while (at < text.size() && (text[at] == ' ' || text[at] == '\t' || text[at] == '\n' || text[at] == '\r')) ++at;
    }

    bool Take(char each) {
      Skip();
      if (at >= text.size() || text[at] != each) return false;
      ++at;
      return true;
    }

    bool Word(std::string_view word) {
      if (text.substr(at, word.size()) != word) return false;
      at += word.size();
      return true;
    }

    bool Value(Json& value, int depth) {
      Skip();
      if (at >= text.size() || depth > kDeepest) return false;
      switch (text[at]) {
        case '{': return Object(value, depth);
        case '[': return Array(value, depth);
        case '"': value.kind_ = Kind::kText; return String(value.text_);
        case 't': value.kind_ = Kind::kBool; value.number_ = 1; return Word("true");
        case 'f': value.kind_ = Kind::kBool; return Word("false");
        case 'n': return Word("null");
        default: return Number(value);
      }
    }

    bool Object(Json& value, int depth) {
      value.kind_ = Kind::kObject;
      ++at;
      if (Take('}')) return true;
      do {
        std::string name;
        Skip();
        if (!String(name) || !Take(':') || !Value(value.members_[name] = Json(), depth + 1)) return false;
      } while (Take(','));
      return Take('}');
    }

    bool Array(Json& value, int depth) {
      value.kind_ = Kind::kArray;
      ++at;
      if (Take(']')) return true;
      do {
        if (!Value(value.items_.emplace_back(), depth + 1)) return false;
      } while (Take(','));
      return Take(']');
    }

    bool Number(Json& value) {
      const std::size_t end = text.find_first_not_of("+-.eE0123456789", at);
      const std::string digits(text.substr(at, end == std::string_view::npos ? end : end - at));
      char* rest = nullptr;
      value.kind_ = Kind::kNumber;
      value.number_ = std::strtod(digits.c_str(), &rest);
      at += digits.size();
      return !digits.empty() && *rest == '\0';
    }

    bool String(std::string& found) {
      if (at >= text.size() || text[at] != '"') return false;
      for (++at; at < text.size(); ++at) {
        const char each = text[at];
        if (each == '"') {
          ++at;
          return true;
        }
        if (each != '\\') {
          found += each;
          continue;
        }
        if (++at >= text.size()) return false;
        switch (text[at]) {
          case 'b': found += '\b'; break;
          case 'f': found += '\f'; break;
          case 'n': found += '\n'; break;
          case 'r': found += '\r'; break;
          case 't': found += '\t'; break;
          case 'u':
            if (!Escape(found)) return false;
            break;
          default: found += text[at];
        }
      }
      return false;
    }

    // Four digits of a character of the first plane, to UTF-8. The server escapes no others.
    bool Escape(std::string& found) {
      const std::string digits(text.substr(at + 1, 4));
      char* rest = nullptr;
      const unsigned long code = std::strtoul(digits.c_str(), &rest, 16);
      if (digits.size() < 4 || *rest != '\0') return false;
      at += 4;
      if (code >= 0x800) found += static_cast<char>(0xe0 | code >> 12);
      if (code >= 0x80) found += static_cast<char>(code >= 0x800 ? 0x80 | (code >> 6 & 0x3f) : 0xc0 | code >> 6);
      found += static_cast<char>(code >= 0x80 ? 0x80 | (code & 0x3f) : code);
      return true;
    }
  };

  Kind kind_ = Kind::kNull;
  double number_ = 0;
  std::string text_;
  std::vector<Json> items_;
  std::map<std::string, Json> members_;
};

}  // namespace nafir
