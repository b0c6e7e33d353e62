// As much of Unreal 5's core as client_examples/unreal/Nafir/NafirListener.cpp uses, so that its syntax and types are checked where there is
// no Unreal. Signatures are those of the engine's manual; nothing here does anything.
#pragma once

#include <cstdint>
#include <functional>
#include <string>

using uint8 = std::uint8_t;
using int32 = std::int32_t;
using SIZE_T = std::size_t;
using TCHAR = char16_t;

#define TEXT(literal) u##literal
#define UE_LOG(category, verbosity, format, ...) ((void)sizeof(format), StubLog(__VA_ARGS__))
#define UCLASS(...)
#define UENUM(...)
#define UPROPERTY(...)
#define UFUNCTION(...)
#define GENERATED_BODY()            \
 private:                           \
  using Super = USynthComponent;    \
                                    \
 public:

template <typename... Given>
void StubLog(Given...) {}

class FString {
 public:
  FString() = default;
  FString(const TCHAR*) {}
  const TCHAR* operator*() const { return u""; }
  bool IsEmpty() const { return true; }
  bool operator<(const FString&) const { return false; }
};
inline FString operator+(const TCHAR*, const FString&) { return {}; }

// The engine's are temporary objects that convert to these pointers.
inline const char* TCHAR_TO_UTF8(const TCHAR*) { return ""; }
inline const TCHAR* UTF8_TO_TCHAR(const char*) { return u""; }

struct FQuat {
  double X = 0, Y = 0, Z = 0, W = 1;
  static const FQuat Identity;
};
inline const FQuat FQuat::Identity{};

struct FVector {
  double X = 0, Y = 0, Z = 0;
};

struct FRotator {
  double Pitch = 0, Yaw = 0, Roll = 0;
  FQuat Quaternion() const { return {}; }
};

struct FMemory {
  static void* Memzero(void* to, SIZE_T) { return to; }
};

template <typename T>
class TArray {
 public:
  void Append(const T*, int32) {}
  void Reset(int32 = 0) {}
  int32 Num() const { return 0; }
  T* GetData() { return nullptr; }
  T& operator[](int32) { return first_; }

 private:
  T first_{};
};

template <typename Key, typename Value>
class TMap {
 public:
  Value& Add(const Key&, const Value& value) { return last_ = value; }

 private:
  Value last_{};
};

template <typename T>
class TSharedPtr {
 public:
  TSharedPtr() = default;
  explicit TSharedPtr(T* given) : held_(given) {}
  T* operator->() const { return held_; }
  explicit operator bool() const { return held_ != nullptr; }
  void Reset() { held_ = nullptr; }
  bool operator==(const TSharedPtr& other) const { return held_ == other.held_; }

 private:
  T* held_ = nullptr;
};

template <typename T>
class TWeakPtr {
 public:
  TWeakPtr(const TSharedPtr<T>& from) : held_(from) {}
  TSharedPtr<T> Pin() const { return held_; }

 private:
  TSharedPtr<T> held_;
};

template <typename... Given>
class TMulticastDelegate {
 public:
  void AddLambda(std::function<void(Given...)>) {}
  void Broadcast(Given...) const {}
};

#define DECLARE_DYNAMIC_MULTICAST_DELEGATE_OneParam(name, type, parameter) using name = TMulticastDelegate<type>
#define DECLARE_DYNAMIC_MULTICAST_DELEGATE_TwoParams(name, type, parameter, type2, parameter2) using name = TMulticastDelegate<type, type2>
