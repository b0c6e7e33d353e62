// As much of Unity as the components of client_examples/unity use, so that they compile and run where there is no Unity.

using System;

namespace UnityEngine
{
    public struct Vector3
    {
        public float x, y, z;

        public Vector3(float x, float y, float z)
        {
            this.x = x;
            this.y = y;
            this.z = z;
        }

        public static Vector3 operator -(Vector3 a, Vector3 b) => new Vector3(a.x - b.x, a.y - b.y, a.z - b.z);
    }

    public struct Quaternion
    {
        public float x, y, z, w;

        public Quaternion(float x, float y, float z, float w)
        {
            this.x = x;
            this.y = y;
            this.z = z;
            this.w = w;
        }

        public static Quaternion Inverse(Quaternion q) => new Quaternion(-q.x, -q.y, -q.z, q.w);

        public static Quaternion operator *(Quaternion a, Quaternion b) => new Quaternion(
            a.w * b.x + a.x * b.w + a.y * b.z - a.z * b.y,
            a.w * b.y - a.x * b.z + a.y * b.w + a.z * b.x,
            a.w * b.z + a.x * b.y - a.y * b.x + a.z * b.w,
            a.w * b.w - a.x * b.x - a.y * b.y - a.z * b.z);

        public static Vector3 operator *(Quaternion q, Vector3 v)
        {
            var turned = q * new Quaternion(v.x, v.y, v.z, 0) * Inverse(q);
            return new Vector3(turned.x, turned.y, turned.z);
        }
    }

    public class Object
    {
        static int made;
        readonly int id = ++made;

        public int GetInstanceID() => -id;
    }

    public class Transform : Object
    {
        public Vector3 position;
        public Quaternion rotation = new Quaternion(0, 0, 0, 1);
    }

    public class MonoBehaviour : Object
    {
        public Transform transform = new Transform();
        public MonoBehaviour beside; // the other component of the object

        public T GetComponent<T>() where T : MonoBehaviour => beside as T;
    }

    public sealed class AudioClip : Object
    {
        public int samples, channels, frequency;
        public float[] ring;

        public bool GetData(float[] data, int offset)
        {
            for (int i = 0; i < data.Length; i++) data[i] = ring[(offset * channels + i) % ring.Length];
            return true;
        }
    }

    // A device that records what `Record` is given.
    public static class Microphone
    {
        static AudioClip clip;
        static int position;

        public static AudioClip Start(string device, bool loop, int lengthSec, int frequency)
        {
            position = 0;
            return clip = new AudioClip { samples = lengthSec * frequency, channels = 2, frequency = frequency, ring = new float[2 * lengthSec * frequency] };
        }

        public static void End(string device) => clip = null;

        public static int GetPosition(string device) => position;

        public static void Record(float sample)
        {
            clip.ring[2 * position] = sample;
            clip.ring[2 * position + 1] = -sample;
            position = (position + 1) % clip.samples;
        }
    }

    public static class AudioSettings
    {
        public static int outputSampleRate = 48000;
    }

    public static class Debug
    {
        public static void LogError(string text, Object of) => Console.Error.WriteLine(text);

        public static void LogWarning(string text, Object of) => Console.Error.WriteLine(text);
    }

    [AttributeUsage(AttributeTargets.Field)]
    public sealed class TooltipAttribute : Attribute
    {
        public TooltipAttribute(string text) { }
    }

    [AttributeUsage(AttributeTargets.Field)]
    public sealed class RangeAttribute : Attribute
    {
        public RangeAttribute(float least, float most) { }
    }

    [AttributeUsage(AttributeTargets.Class)]
    public sealed class RequireComponentAttribute : Attribute
    {
        public RequireComponentAttribute(Type type) { }
    }

    [AttributeUsage(AttributeTargets.Class)]
    public sealed class AddComponentMenuAttribute : Attribute
    {
        public AddComponentMenuAttribute(string place) { }
    }
}
