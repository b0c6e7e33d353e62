// Poses of Unity and of Nafir. Without a type of Unity's, so that it also compiles elsewhere.
//
// Nafir: metres; x east, y north, z up, right-handed. The identity looks along +x, with the left ear along +y.
// Unity: metres; x right, y up, z ahead, left-handed. The identity looks along +z, with the right ear along +x.
// Quaternions are (x, y, z, w) in both.

namespace Nafir
{
    public struct NafirVector
    {
        public float X, Y, Z;

        public NafirVector(float x, float y, float z)
        {
            X = x;
            Y = y;
            Z = z;
        }
    }

    public struct NafirQuaternion
    {
        public float X, Y, Z, W;

        public NafirQuaternion(float x, float y, float z, float w)
        {
            X = x;
            Y = y;
            Z = z;
            W = w;
        }

        public static NafirQuaternion Identity => new NafirQuaternion(0, 0, 0, 1);
    }

    /// <summary>A position and an orientation in the server's axes.</summary>
    public struct NafirPose
    {
        const float HalfRoot = 0.70710678f; // sine and cosine of half a quarter turn

        public NafirVector Position;
        public NafirQuaternion Orientation;

        public NafirPose(NafirVector position, NafirQuaternion orientation)
        {
            Position = position;
            Orientation = orientation;
        }

        /// <summary>The pose of a Transform with this position and rotation.</summary>
        public static NafirPose FromUnity(NafirVector position, NafirQuaternion rotation)
        {
            // Exchanging y and z mirrors, so the three turns are reversed. Then comes a quarter turn from "ahead is z" to "ahead is x".
            float x = -rotation.X, y = -rotation.Z, z = -rotation.Y, w = rotation.W;
            return new NafirPose(
                new NafirVector(position.X, position.Z, position.Y),
                new NafirQuaternion(HalfRoot * (x + y), HalfRoot * (y - x), HalfRoot * (z + w), HalfRoot * (w - z)));
        }

        /// <summary>Where a Transform has to be, and how turned, to have this pose.</summary>
        public void ToUnity(out NafirVector position, out NafirQuaternion rotation)
        {
            var q = Orientation;
            position = new NafirVector(Position.X, Position.Z, Position.Y);
            rotation = new NafirQuaternion(
                -HalfRoot * (q.X - q.Y), -HalfRoot * (q.Z - q.W), -HalfRoot * (q.X + q.Y), HalfRoot * (q.W + q.Z));
        }
    }
}
