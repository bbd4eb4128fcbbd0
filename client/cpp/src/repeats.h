// Whether what is stored is what a change, whose answer was lost, was to store. Not installed.
#pragma once

#include "mapless/client.h"

namespace mapless {

// A scene as it was to be created, unchanged since.
bool IsSame(const v1::CreateSceneRequest& wanted, const v1::Scene& stored);
// A reference with its photograph, mask and depth: the same bytes, camera and pose.
bool IsSame(const v1::Reference& wanted, const v1::Reference& stored);

}  // namespace mapless
