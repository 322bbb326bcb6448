// Asks a running service the six questions about a bedroom: ./example [URL [SECONDS]]
#include <cstdio>
#include <cstdlib>
#include <iostream>

#include "scene_client.hpp"

using scene::json;

// Prints a relation of an answer, without a line end.
static void print(const json& entry) {
  std::cout << "  " << entry["subject"].get<std::string>() << " "
            << entry["relation"].get<std::string>() << " " << entry["object"].get<std::string>()
            << " " << entry["probability"];
}

int main(int argc, char** argv) {
  scene::Options options;
  if (argc > 1) options.url = argv[1];
  char* end = nullptr;
  options.timeout = scene::Seconds(argc > 2 ? std::strtod(argv[2], &end) : 0.5);
  if (argc > 2 && (end == argv[2] || *end != '\0')) {
    std::cerr << "SECONDS must be a number, not '" << argv[2] << "'\n";
    return 2;
  }

  // The detector is unsure: it may also be a candle. The other objects decide (`resolved`).
  const json candle = {{"label", "candle"}, {"confidence", 0.3}};
  json lamp = {{"id", "lamp_1"}, {"label", "lamp"}, {"confidence", 0.6}};
  lamp["alternatives"] = json::array({candle});
  const json on = {{"subject", "lamp_1"}, {"relation", "on-top"}, {"object", "nightstand"}};
  json room;
  room["objects"] = {"bed", "nightstand", lamp};
  room["relations"] = json::array({on});
  room["unknown_labels"] = "by-meaning";  // reads every word of a detector

  try {
    scene::Client service(options);  // throws where the URL is none
    json question = room;
    question["top_k"] = 3;
    std::cout << "Missing:\n";
    const json missing = service.missing(question);
    for (const auto& entry : missing["missing"])
      std::printf("  %-20s %.3f\n", entry["label"].get<std::string>().c_str(),
                  entry["probability"].get<double>());

    std::cout << "How they stand:\n";
    const json relations = service.relations(question);
    for (const auto& entry : relations["relations"]) {
      print(entry);
      // Only an observed relation has an expected probability.
      if (entry.contains("expected") && entry["expected"].is_number())
        std::cout << " expected " << entry["expected"];
      std::cout << "\n";
    }

    std::cout << "Least fitting first:\n";
    const json outliers = service.outliers(room);
    for (const auto& entry : outliers.value("resolved", json::array()))
      std::cout << "  " << entry["object"].get<std::string>() << " is probably a "
                << entry["labels"][0]["label"].get<std::string>() << "\n";
    for (const auto& entry : outliers["outliers"])
      std::cout << "  " << entry["object"].get<std::string>() << " " << entry["probability"]
                << (entry["is_outlier"].get<bool>() ? " does not belong here" : "") << "\n";
    for (const auto& entry : outliers["misplaced"]) {
      if (!entry.value("is_misplaced", false)) continue;
      print(entry);
      if (entry.contains("moved") && entry["moved"].is_string())
        std::cout << " moved " << entry["moved"].get<std::string>();
      std::cout << "\n";
    }

    std::cout << "Which room it is:\n";
    question = {{"objects", room["objects"]}, {"top_k", 3}};
    question["unknown_labels"] = "by-meaning";
    const json rooms = service.rooms(question);
    for (const auto& entry : rooms["room_types"])
      std::cout << "  " << entry["room_type"].get<std::string>() << " " << entry["probability"]
                << "\n";

    std::cout << "Where the phone is:\n";
    const json bedroom = {{"id", "bedroom"}, {"objects", room["objects"]}};
    const json kitchen = {{"id", "kitchen"}, {"objects", {"fridge", "stove", "counter"}}};
    question = {{"label", "phone"}, {"rooms", {bedroom, kitchen}}, {"top_k", 3}};
    question["unknown_labels"] = "by-meaning";
    question["searched"] = json::array({{{"room", "kitchen"}, {"object", "counter"}}});
    const json places = service.where(question);
    for (const auto& place : places["places"]) {
      std::cout << "  " << place["room"].get<std::string>();
      if (place.contains("relation"))  // the rest of the room has no relation
        std::cout << " " << place["relation"].get<std::string>() << " "
                  << place["object"].get<std::string>();
      std::cout << " " << place["probability"] << "\n";
    }
    std::cout << "  not here " << places["not_here"] << "\n";

    std::cout << "A scene like it:\n";
    question = {{"objects", {"bed"}}, {"seed", 7}};
    const json drawn = service.generate(question);
    std::cout << "  " << drawn["scenes"][0]["objects"].dump() << "\n";
  } catch (const scene::ProblemError& problem) {
    std::cerr << problem.what() << "\n";  // problem.type says which kind; problem.errors, where
    return 1;
  } catch (const scene::Error& error) {
    std::cerr << error.what() << "\n";  // too late, or nobody there: the robot goes on without
    return 2;
  }
  return 0;
}
