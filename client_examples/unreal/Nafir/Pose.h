// Poses of Unreal and of Nafir. C++17, no types of Unreal.
//
// Nafir: metres; x east, y north, z up, right-handed. The identity looks along +x, with the left ear along +y.
// Unreal: centimetres; x ahead, y right, z up, left-handed. The identity looks along +x, with the right ear along +y.
// Quaternions are (x, y, z, w) in both, as in FQuat.
#pragma once

namespace nafir {

struct Vector {
  double x = 0, y = 0, z = 0;
};

struct Quaternion {
  double x = 0, y = 0, z = 0, w = 1;
};

struct Pose {
  Vector position;
  Quaternion orientation;
};

inline constexpr double kCentimetresPerMetre = 100;

// The y axes point in opposite directions. A mirror keeps the turn about its own axis and reverses the other two.

inline constexpr Vector PositionFromUnreal(Vector location) {
  return {location.x / kCentimetresPerMetre, -location.y / kCentimetresPerMetre, location.z / kCentimetresPerMetre};
}

inline constexpr Vector PositionToUnreal(Vector position) {
  return {position.x * kCentimetresPerMetre, -position.y * kCentimetresPerMetre, position.z * kCentimetresPerMetre};
}

inline constexpr Quaternion OrientationFromUnreal(Quaternion rotation) {
  return {-rotation.x, rotation.y, -rotation.z, rotation.w};
}

inline constexpr Quaternion OrientationToUnreal(Quaternion orientation) {
  return {-orientation.x, orientation.y, -orientation.z, orientation.w};
}

// What an actor's GetActorLocation and GetActorQuat are to the server.
inline constexpr Pose FromUnreal(Vector location, Quaternion rotation) {
  return {PositionFromUnreal(location), OrientationFromUnreal(rotation)};
}

}  // namespace nafir
