#pragma once

#include "Camera/PlayerCameraManager.h"
#include "Components/SynthComponent.h"

class UGameplayStatics {
 public:
  static APlayerCameraManager* GetPlayerCameraManager(const UObject* context, int32 player);
};
