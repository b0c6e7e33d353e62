#pragma once

#include "CoreMinimal.h"

class APlayerCameraManager {
 public:
  FVector GetCameraLocation() const { return {}; }
  FRotator GetCameraRotation() const { return {}; }
};
