#pragma once

#include "CoreMinimal.h"

struct EEndPlayReason {
  enum Type { Destroyed };
};
enum ELevelTick { LEVELTICK_All };

struct FActorComponentTickFunction {
  void SetTickFunctionEnable(bool) {}
};

class UObject {};

class USynthComponent : public UObject {
 public:
  virtual ~USynthComponent() = default;
  void Start() {}
  void Stop() {}

 protected:
  virtual bool Init(int32&) { return true; }
  virtual int32 OnGenerateAudio(float*, int32 samples) { return samples; }
  virtual void BeginPlay() {}
  virtual void EndPlay(const EEndPlayReason::Type) {}
  virtual void TickComponent(float, ELevelTick, FActorComponentTickFunction*) {}

  FActorComponentTickFunction PrimaryComponentTick;
  int32 NumChannels = 2;
};
