// What a camera is told to do: lines of "key value" in a file that a test may rewrite at any time.
#pragma once

#include <sys/stat.h>

#include <cstdint>
#include <fstream>
#include <map>
#include <memory>
#include <sstream>
#include <string>

namespace virtualcam {

class Script {
public:
    explicit Script(const std::string& path) {
        std::ifstream file(path);
        std::string line;
        while (std::getline(file, line)) {
            std::istringstream words(line);
            std::string key, value;
            if (!(words >> key)) continue;
            std::getline(words >> std::ws, value);
            values_[key] = value;
        }
    }

    std::string text(const std::string& key, const std::string& otherwise = "") const {
        auto found = values_.find(key);
        return found == values_.end() ? otherwise : found->second;
    }

    long number(const std::string& key, long otherwise) const {
        auto found = values_.find(key);
        return found == values_.end() ? otherwise : std::strtol(found->second.c_str(), nullptr, 0);
    }

    double real(const std::string& key, double otherwise) const {
        auto found = values_.find(key);
        return found == values_.end() ? otherwise : std::strtod(found->second.c_str(), nullptr);
    }

    // Whether a frame number is in a list such as "3,10-12"; "20-" has no end.
    bool lists(const std::string& key, long frame) const {
        std::istringstream parts(text(key));
        std::string part;
        while (std::getline(parts, part, ',')) {
            char* rest = nullptr;
            const long first = std::strtol(part.c_str(), &rest, 10);
            long last = first;
            if (*rest == '-') last = rest[1] == '\0' ? INT32_MAX : std::strtol(rest + 1, nullptr, 10);
            if (frame >= first && frame <= last) return true;
        }
        return false;
    }

private:
    std::map<std::string, std::string> values_;
};

using ScriptPointer = std::shared_ptr<const Script>;

// Identifies a version of a file, so that it is read again only when it was replaced.
struct FileVersion {
    ino_t inode = 0;
    int64_t modified_ns = -1;

    static FileVersion of(const std::string& path) {
        struct stat status {};
        FileVersion version;
        if (stat(path.c_str(), &status) == 0) {
            version.inode = status.st_ino;
            version.modified_ns = status.st_mtim.tv_sec * 1000000000LL + status.st_mtim.tv_nsec;
        }
        return version;
    }
    bool exists() const { return modified_ns >= 0; }
    bool operator!=(const FileVersion& other) const {
        return inode != other.inode || modified_ns != other.modified_ns;
    }
};

}  // namespace virtualcam
