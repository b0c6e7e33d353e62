// JSON without a library, since Unity's own reader needs a class for every message.

using System;
using System.Collections.Generic;
using System.Globalization;
using System.Text;

namespace Nafir
{
    /// <summary>Reads JSON to Dictionary, List, string, double, bool and null.</summary>
    public sealed class NafirJson
    {
        const int Deepest = 64;

        readonly string text;
        int at;

        NafirJson(string text) => this.text = text;

        /// <summary>The object that a message is. Throws FormatException if it is none.</summary>
        public static Dictionary<string, object> ParseObject(string text)
        {
            var reader = new NafirJson(text);
            var value = reader.Value(0);
            reader.Skip();
            if (reader.at != text.Length) throw reader.Unexpected();
            return value as Dictionary<string, object> ?? throw new FormatException("not a JSON object");
        }

        /// <summary>A string as it stands in JSON, with its quotes.</summary>
        public static string Quote(string value)
        {
            var quoted = new StringBuilder("\"");
            foreach (var each in value)
            {
                if (each == '"' || each == '\\') quoted.Append('\\').Append(each);
                else if (each < ' ') quoted.Append("\\u").Append(((int)each).ToString("x4"));
                else quoted.Append(each);
            }
            return quoted.Append('"').ToString();
        }

        object Value(int depth)
        {
            if (depth > Deepest) throw new FormatException("JSON is nested too deeply");
            Skip();
            switch (Peek())
            {
                case '{': return Object(depth);
                case '[': return Array(depth);
                case '"': return String();
                case 't': return Word("true", true);
                case 'f': return Word("false", false);
                case 'n': return Word("null", null);
                default: return Number();
            }
        }

        Dictionary<string, object> Object(int depth)
        {
            var found = new Dictionary<string, object>();
            Expect('{');
            if (Ends('}')) return found;
            do
            {
                Skip();
                var key = String();
                Skip();
                Expect(':');
                found[key] = Value(depth + 1);
            }
            while (Continues('}'));
            return found;
        }

        List<object> Array(int depth)
        {
            var found = new List<object>();
            Expect('[');
            if (Ends(']')) return found;
            do found.Add(Value(depth + 1));
            while (Continues(']'));
            return found;
        }

        string String()
        {
            Expect('"');
            var found = new StringBuilder();
            for (;;)
            {
                var each = Next();
                if (each == '"') return found.ToString();
                if (each != '\\')
                {
                    found.Append(each);
                    continue;
                }
                each = Next();
                switch (each)
                {
                    case 'b': found.Append('\b'); break;
                    case 'f': found.Append('\f'); break;
                    case 'n': found.Append('\n'); break;
                    case 'r': found.Append('\r'); break;
                    case 't': found.Append('\t'); break;
                    case 'u':
                        if (at + 4 > text.Length) throw Unexpected();
                        found.Append((char)ushort.Parse(text.Substring(at, 4), NumberStyles.AllowHexSpecifier, CultureInfo.InvariantCulture));
                        at += 4;
                        break;
                    default: found.Append(each); break;
                }
            }
        }

        object Number()
        {
            var start = at;
            while (at < text.Length && "+-.eE0123456789".IndexOf(text[at]) >= 0) at++;
            var isNumber = double.TryParse(text.Substring(start, at - start), NumberStyles.Float, CultureInfo.InvariantCulture, out var value);
            if (!isNumber) throw Unexpected();
            return value;
        }

        object Word(string word, object value)
        {
            if (string.CompareOrdinal(text, at, word, 0, word.Length) != 0) throw Unexpected();
            at += word.Length;
            return value;
        }

        bool Ends(char end)
        {
            Skip();
            if (Peek() != end) return false;
            at++;
            return true;
        }

        bool Continues(char end)
        {
            Skip();
            var each = Next();
            if (each != ',' && each != end) throw Unexpected();
            return each == ',';
        }

        void Skip()
        {
            while (at < text.Length && char.IsWhiteSpace(text[at])) at++;
        }

        char Peek() => at < text.Length ? text[at] : '\0';

        char Next() => at < text.Length ? text[at++] : throw Unexpected();

        void Expect(char wanted)
        {
            if (Next() != wanted) throw Unexpected();
        }

        FormatException Unexpected() => new FormatException($"unexpected JSON at character {at}");
    }
}
